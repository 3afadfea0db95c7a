// Runs a fuzz target without libFuzzer:
//
//   test_fuzz_TARGET FILE_OR_FOLDER... [--mutations N] [--seed S]
//       runs these inputs, and N mutations of them (see repeats()), which are the same for the same S
//   test_fuzz_TARGET --write-seeds FOLDER
//       writes the seeds of the target
//
// If a run crashes, its input is left in crash-input.
#include "../support/brief.hpp"
#include "fuzz.hpp"

#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <random>
#include <string>
#include <vector>

#if defined(__has_include)
#if __has_include(<sanitizer/common_interface_defs.h>) && (defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__))
#include <sanitizer/common_interface_defs.h>
#define DFB_FUZZ_SANITIZED 1
#elif defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#include <sanitizer/common_interface_defs.h>
#define DFB_FUZZ_SANITIZED 1
#endif
#endif
#endif

namespace {

using Random = std::mt19937_64;

const std::string* current = nullptr; // the input that is running

void keepCurrent()
{
    if (!current)
        return;
    if (std::FILE* file = std::fopen("crash-input", "wb")) {
        std::fwrite(current->data(), 1, current->size(), file);
        std::fclose(file);
        std::fputs("fuzz: the input is in crash-input\n", stderr);
    }
    current = nullptr;
}

void onSignal(int number)
{
    keepCurrent();
    std::signal(number, SIG_DFL);
    std::raise(number);
}

void run(const std::string& input)
{
    current = &input;
    try {
        LLVMFuzzerTestOneInput(reinterpret_cast<const std::uint8_t*>(input.data()), input.size());
    } catch (const std::exception& e) {
        fuzz::fail(std::string("an exception gets out: ") + e.what());
    }
    current = nullptr;
}

std::size_t below(Random& random, std::size_t count) { return count == 0 ? 0 : random() % count; }

// Little-endian numbers that often reveal errors of sizes and signs.
std::string oddNumber(Random& random)
{
    static const std::uint64_t odd[] = {0,
                                        1,
                                        0x7f,
                                        0x80,
                                        0xff,
                                        0x100,
                                        0x7fff,
                                        0x8000,
                                        0xffff,
                                        0x10000,
                                        0x7fffffff,
                                        0x80000000u,
                                        0xffffffffu,
                                        0x100000000u,
                                        0x7fffffffffffffffu,
                                        0x8000000000000000u,
                                        0xffffffffffffffffu};
    const std::uint64_t value = odd[below(random, std::size(odd))];
    const std::size_t count = std::size_t{1} << below(random, 4);
    std::string bytes;
    for (std::size_t i = 0; i < count; ++i)
        bytes += static_cast<char>(value >> (8 * i) & 0xff);
    return bytes;
}

void mutate(std::string& input, const std::vector<std::string>& corpus, Random& random)
{
    for (std::size_t steps = 1 + below(random, 4); steps > 0; --steps) {
        // Mutates mostly the front, as sizes and kinds are there.
        const std::size_t reach = below(random, 2) ? input.size() : std::min<std::size_t>(input.size(), 80);
        const std::size_t at = below(random, reach);
        const std::size_t count = std::min(input.size() - at, 1 + below(random, 24));
        switch (below(random, 8)) {
        case 0:
            if (!input.empty())
                input[at] = static_cast<char>(static_cast<unsigned char>(input[at]) ^ (1u << below(random, 8)));
            break;
        case 1:
            if (!input.empty())
                input[at] = static_cast<char>(random());
            break;
        case 2: {
            const std::string number = oddNumber(random);
            input.replace(at, std::min(number.size(), input.size() - at), number);
            break;
        }
        case 3: input.erase(at, count); break;
        case 4: input.insert(at, input.substr(at, count)); break;
        case 5: {
            const std::string& other = corpus[below(random, corpus.size())];
            const std::size_t from = below(random, other.size());
            input.replace(at, below(random, 2) ? count : std::string::npos, other.substr(from, 1 + below(random, 120)));
            break;
        }
        case 6: {
            const std::string& other = corpus[below(random, corpus.size())];
            input = input.substr(0, at) + other.substr(std::min(at, other.size()));
            break;
        }
        default:
            if (below(random, 4) == 0)
                input.resize(at);
            else if (!input.empty())
                input[at] = static_cast<char>(input[at] + (below(random, 2) ? 1 : -1));
        }
        if (input.size() > 4096)
            input.resize(4096);
    }
}

std::string read(const std::filesystem::path& path)
{
    std::ifstream file(path, std::ios::binary);
    return std::string(std::istreambuf_iterator<char>(file), {});
}

int writeSeeds(const std::filesystem::path& folder)
{
    std::filesystem::create_directories(folder);
    for (const auto& [name, bytes] : fuzz::seeds())
        std::ofstream(folder / name, std::ios::binary) << bytes;
    return 0;
}

int runAll(const std::vector<std::string>& arguments)
{
    std::vector<std::filesystem::path> files;
    int mutations = 0;
    unsigned long long seed = 1;
    for (std::size_t i = 0; i < arguments.size(); ++i) {
        if (arguments[i] == "--mutations")
            mutations = repeats(std::stoi(arguments.at(++i)));
        else if (arguments[i] == "--seed")
            seed = std::stoull(arguments.at(++i));
        else if (arguments[i] == "--write-seeds")
            return writeSeeds(arguments.at(i + 1));
        else if (std::filesystem::is_directory(arguments[i]))
            for (const auto& entry : std::filesystem::directory_iterator(arguments[i]))
                files.push_back(entry.path());
        else
            files.emplace_back(arguments[i]);
    }
    std::sort(files.begin(), files.end());
    std::vector<std::string> corpus;
    for (const auto& file : files) {
        corpus.push_back(read(file));
        run(corpus.back());
    }
    for (const auto& [name, bytes] : fuzz::seeds()) {
        corpus.push_back(bytes);
        run(bytes);
    }
    if (files.empty() || corpus.empty()) {
        std::fputs("fuzz: no inputs\n", stderr);
        return 1;
    }
    Random random(seed);
    for (int i = 0; i < mutations; ++i) {
        std::string input = corpus[below(random, corpus.size())];
        mutate(input, corpus, random);
        run(input);
    }
    std::printf("fuzz: %zu kept inputs, %d made of them\n", corpus.size(), mutations);
    return 0;
}

} // namespace

int main(int argc, char** argv)
{
    for (const int number : {SIGABRT, SIGSEGV, SIGFPE, SIGILL})
        std::signal(number, onSignal);
#if defined(DFB_FUZZ_SANITIZED)
    __sanitizer_set_death_callback(keepCurrent);
#endif
    try {
        return runAll({argv + 1, argv + argc});
    } catch (const std::exception& e) {
        std::fprintf(stderr, "fuzz: %s\n", e.what());
        return 1;
    }
}
