// compare_pfm A B TOLERANCE FRACTION
// Succeeds if two PFM files have the same size and kind, and if at most a fraction FRACTION of their pixels differs by
// more than TOLERANCE in any channel.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

struct Pfm {
    std::string kind, scale;
    std::size_t width = 0, height = 0;
    std::vector<float> values;

    std::size_t planes() const { return kind == "PF" ? 3 : 1; }
};

Pfm readPfm(const char* path)
{
    std::ifstream stream(path, std::ios::binary);
    Pfm pfm;
    stream >> pfm.kind >> pfm.width >> pfm.height >> pfm.scale;
    if (!stream || (pfm.kind != "PF" && pfm.kind != "Pf") || pfm.scale != "-1.0" || stream.get() != '\n')
        throw std::runtime_error(std::string(path) + ": no little-endian PFM");
    pfm.values.resize(pfm.width * pfm.height * pfm.planes());
    stream.read(reinterpret_cast<char*>(pfm.values.data()), static_cast<std::streamsize>(4 * pfm.values.size()));
    if (!stream || stream.get() != std::ifstream::traits_type::eof())
        throw std::runtime_error(std::string(path) + ": not of the size that it says");
    return pfm;
}

} // namespace

int main(int argc, char** argv)
{
    try {
        if (argc != 5)
            throw std::runtime_error("usage: compare_pfm A B TOLERANCE FRACTION");
        const Pfm a = readPfm(argv[1]), b = readPfm(argv[2]);
        const double tolerance = std::atof(argv[3]), fraction = std::atof(argv[4]);
        if (a.kind != b.kind || a.width != b.width || a.height != b.height)
            throw std::runtime_error("images of different sizes or kinds");
        std::size_t off = 0;
        double largest = 0;
        for (std::size_t pixel = 0; pixel < a.width * a.height; ++pixel) {
            bool isOff = false;
            for (std::size_t i = pixel * a.planes(); i < (pixel + 1) * a.planes(); ++i) {
                if (a.values[i] == b.values[i])
                    continue; // infinite depths too
                const double difference =
                    std::fabs(static_cast<double>(a.values[i]) - static_cast<double>(b.values[i]));
                if (!(difference <= largest))
                    largest = difference;
                isOff = isOff || !(difference <= tolerance);
            }
            off += isOff;
        }
        const std::size_t allowed = static_cast<std::size_t>(fraction * static_cast<double>(a.width * a.height));
        std::printf("largest difference %.3g, %zu of %zu pixels off by more than %g, %zu allowed\n", largest, off,
                    a.width * a.height, tolerance, allowed);
        return off <= allowed ? 0 : 1;
    } catch (const std::exception& e) {
        std::fprintf(stderr, "compare_pfm: %s\n", e.what());
        return 2;
    }
}
