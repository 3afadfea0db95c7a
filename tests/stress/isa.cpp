// Composites adversarial tiles and writes all values to a file, or compares two such files, whose values may differ by
// MOST_ULPS; 0: not in a single bit. Built for several instruction sets and by two compilers.
//   isa write FILE        isa compare FILE FILE MOST_ULPS
#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/adversarial.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <string>
#include <vector>

namespace {

int write(const char* path)
{
    std::ofstream file(path, std::ios::binary);
    const auto put = [&](float value) { file.write(reinterpret_cast<const char*>(&value), sizeof value); };
    for (std::uint64_t seed = 1; seed <= 80; ++seed) {
        using Op = dfb::BasicAlphaBlend<16>;
        const auto in =
            dfb::testing::adversarial<16>(seed, 2 + static_cast<int>(seed % 60), 1 + static_cast<int>(seed % 2));
        const auto out = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F);
        for (std::size_t i = 0; i < out.color.size() / sizeof(float); ++i)
            put(out.value(i));
        // A level is exact, so another one is never within an ulp.
        for (const auto format : {dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8})
            for (const std::byte level : dfb::testing::runTileOp<Op>(in, in.order(), format).color)
                put(static_cast<float>(level));
        // A dithered one may differ by 1 where floats do; so that this is an ulp, it is counted from 1.
        for (const auto format : {dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8})
            for (const std::byte level : dfb::testing::runTileOp<Op>(in, in.order(), format, true, {}, true).color)
                put(1.0f + 0x1p-23f * static_cast<float>(level));
    }
    for (int layers = 2; layers <= 32; layers *= 2) {
        const auto in = dfb::testing::greyLayers<16>(1, layers);
        for (const std::byte level :
             dfb::testing::runTileOp<dfb::BasicAlphaBlend<16>>(in, in.order(), dfb::OutputFormat::RGBA8).color)
            put(static_cast<float>(level));
    }
    return file.flush() ? 0 : 1;
}

std::vector<float> read(const char* path)
{
    std::ifstream file(path, std::ios::binary | std::ios::ate);
    std::vector<float> values(static_cast<std::size_t>(std::max<std::streamoff>(0, file.tellg())) / sizeof(float));
    file.seekg(0);
    file.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(values.size() * sizeof(float)));
    return values;
}

int compare(const char* a, const char* b, std::int64_t most)
{
    const std::vector<float> x = read(a), y = read(b);
    std::int64_t worst = 0, different = 0;
    for (std::size_t i = 0; i < std::min(x.size(), y.size()); ++i) {
        const std::int64_t ulps = dfb::testing::ulpsBetween(x[i], y[i]);
        different += std::memcmp(&x[i], &y[i], sizeof(float)) != 0; // 0 and -0 differ here
        worst = std::max(worst, ulps);
    }
    std::printf("%lld of %zu values differ, by up to %lld ulp\n", static_cast<long long>(different), x.size(),
                static_cast<long long>(worst));
    return x.empty() || x.size() != y.size() || worst > most || (most == 0 && different > 0) ? 1 : 0;
}

} // namespace

int main(int argc, char** argv)
{
    const std::string what = argc > 1 ? argv[1] : "";
    if (what == "write" && argc == 3)
        return write(argv[2]);
    if (what == "compare" && argc == 5)
        return compare(argv[2], argv[3], std::atoll(argv[4]));
    std::fprintf(stderr, "usage: isa write FILE | isa compare FILE FILE MOST_ULPS\n");
    return 2;
}
