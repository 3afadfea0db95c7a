// dfb_make_volume head|vessels FOLDER: writes volumes that resemble medical scans, to look at and to test with.
//
// head: 128x128x57 voxels of 1:1:2, uint16, 1024 above Hounsfield units: air with noise, skin, muscle, skull, brain.
// vessels: 128^3, uint8: a tree of bright tubes in noise, less than 1 % of the voxels.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <functional>
#include <random>
#include <string>
#include <vector>

namespace {

using Point = std::array<double, 3>;

double distance(const Point& a, const Point& b) { return std::hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]); }

template <class T>
bool write(const std::string& path, const std::vector<T>& voxels)
{
    std::ofstream stream(path, std::ios::binary);
    stream.write(reinterpret_cast<const char*>(voxels.data()), static_cast<std::streamsize>(voxels.size() * sizeof(T)));
    stream.close();
    return static_cast<bool>(stream);
}

// How far a point is inside of an ellipsoid, about, in the units of its half axes; negative outside.
double inside(const Point& p, const Point& center, const Point& half)
{
    const double r =
        std::hypot((p[0] - center[0]) / half[0], (p[1] - center[1]) / half[1], (p[2] - center[2]) / half[2]);
    return (1 - r) * std::min({half[0], half[1], half[2]});
}

// x to the left, y to the back, z to the top, in mm; the head's centre is the origin.
double hounsfield(const Point& p)
{
    const double head = std::max({inside(p, {0, 0, 6}, {44, 54, 50}), inside(p, {0, -18, -26}, {33, 36, 34}),
                                  inside(p, {0, -55, -12}, {7, 11, 10}), inside(p, {0, 14, -58}, {27, 27, 45}),
                                  inside(p, {46, 4, -12}, {4, 9, 12}), inside(p, {-46, 4, -12}, {4, 9, 12})});
    if (head < 0)
        return -1000;
    if (head < 1.5)
        return -60 + 60 * head; // skin, and fat below it
    const double skull = inside(p, {0, 2, 8}, {39, 48, 44}), face = inside(p, {0, -20, -26}, {26, 29, 28});
    const bool isEye = std::min(distance(p, {17, -38, -6}), distance(p, {-17, -38, -6})) < 11;
    const bool isAirway = inside(p, {0, -36, -24}, {6, 20, 11}) > 0 || inside(p, {0, 2, -60}, {6, 6, 40}) > 0;
    const bool isSpine = inside(p, {0, 24, -60}, {11, 9, 50}) > 0;
    if (isAirway)
        return -950;
    if (isEye)
        return 10;
    if (isSpine)
        return 500;
    if (skull > 6)
        return 35 + 8 * std::sin(0.5 * p[0]) * std::sin(0.4 * p[1] + 0.3 * p[2]); // brain
    if (skull > 0)
        return skull > 1.7 && skull < 4.3 ? 650 : 1150; // two tables, and spongy bone between
    if (face > 0 && face < 5)
        return 850;
    if (std::fabs(face) < 1.5 && p[1] < -40 && p[2] < -36 && p[2] > -44)
        return 1800; // teeth
    return 50;
}

bool makeHead(const std::string& folder)
{
    std::mt19937 random(7);
    std::normal_distribution<double> noise(0, 12);
    std::vector<std::uint16_t> voxels;
    for (int z = 0; z < 57; ++z)
        for (int y = 0; y < 128; ++y)
            for (int x = 0; x < 128; ++x) {
                double sum = 0; // a voxel sees its surroundings
                for (int i = 0; i < 27; ++i)
                    sum += hounsfield(
                        {x - 63.5 + 0.5 * (i % 3 - 1), y - 63.5 + 0.5 * (i / 3 % 3 - 1), 2 * (z - 31.0) + (i / 9 - 1)});
                const double value = sum / 27 + 1024 + noise(random);
                voxels.push_back(static_cast<std::uint16_t>(std::clamp(value, 0.0, 4095.0)));
            }
    return write(folder + "/head_128x128x57_uint16.raw", voxels);
}

bool makeVessels(const std::string& folder)
{
    const int n = 128;
    std::mt19937 random(5);
    std::normal_distribution<double> noise(0, 3), turn(0, 0.16);
    std::vector<double> field(static_cast<std::size_t>(n) * n * n, 0);
    const auto blob = [&](const Point& p, double radius) {
        const int reach = static_cast<int>(radius + 2);
        for (int z = -reach; z <= reach; ++z)
            for (int y = -reach; y <= reach; ++y)
                for (int x = -reach; x <= reach; ++x) {
                    const int i = static_cast<int>(p[0]) + x, j = static_cast<int>(p[1]) + y,
                              k = static_cast<int>(p[2]) + z;
                    if (std::min({i, j, k}) < 0 || std::max({i, j, k}) >= n)
                        continue;
                    const double d =
                        distance(p, {static_cast<double>(i), static_cast<double>(j), static_cast<double>(k)});
                    double& v = field[static_cast<std::size_t>((k * n + j) * n + i)];
                    v = std::max(v, 190 * std::clamp(radius + 0.5 - d, 0.0, 1.0));
                }
    };
    const std::function<void(Point, Point, double, int)> grow = [&](Point p, Point d, double radius, int depth) {
        const int steps = 34 + static_cast<int>(random() % 20);
        for (int i = 0; i < steps && radius > 0.5; ++i) {
            blob(p, radius);
            for (std::size_t c = 0; c < 3; ++c) {
                d[c] += turn(random);
                p[c] += 0.8 * d[c];
            }
            const double l = distance(d, {0, 0, 0});
            for (double& c : d)
                c /= l;
            radius *= 0.994;
        }
        for (int child = 0; depth > 0 && child < 2; ++child)
            grow(p, {d[0] + 4 * turn(random), d[1] + 4 * turn(random), d[2] + 4 * turn(random)}, 0.76 * radius,
                 depth - 1);
    };
    grow({40, 64, 2}, {0.1, 0, 1}, 3.4, 5);
    grow({88, 60, 2}, {-0.1, 0, 1}, 3.2, 5);
    blob({58, 60, 52}, 6.5); // what the scan was made for
    std::vector<std::uint8_t> voxels;
    for (const double value : field)
        voxels.push_back(static_cast<std::uint8_t>(std::clamp(value + 6 + noise(random), 0.0, 255.0)));
    return write(folder + "/vessels_128x128x128_uint8.raw", voxels);
}

} // namespace

int main(int argc, char** argv)
{
    const std::string kind = argc == 3 ? argv[1] : "";
    if (kind == "head" || kind == "vessels")
        return (kind == "head" ? makeHead(argv[2]) : makeVessels(argv[2])) ? 0 : 1;
    std::fprintf(stderr, "usage: dfb_make_volume head|vessels FOLDER\n");
    return 2;
}
