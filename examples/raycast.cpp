// A volume renderer for several ranks, in one file. The volume is cut into bricks, and each rank reads and renders its
// own. A pixel's ray collects light in each brick that it meets; the library sorts these colours by depth and blends
// them.
//   mpirun -n 4 raycast [VOLUME [FROM [BRICKS]]]      writes raycast.ppm
// VOLUME is a file such as head_256x256x128_uint8.raw: sizes and type of the voxels (uint8, uint16 or float32) are in
// its name, x is fastest. Without a file a knot is rendered. Values below FROM (0.15; 0 to 1 is the whole range) are
// transparent. BRICKS (8) does not depend on the number of ranks. With the same bricks the picture is the same, bit for
// bit, on any number of ranks.
#include <dfb/dfb.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <fstream>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

constexpr int width = 640, height = 480, ghost = 2; // ghost: voxels around a brick that its gradients need

using Index = std::array<int, 3>;

// Voxel values on the points of a grid. Their coordinates in space are their indices.
struct Volume {
    Index size{96, 96, 96};
    std::string path; // empty: the knot
    int bytesPerVoxel = 1;
};

Volume volumeOf(const std::string& path)
{
    Volume volume;
    volume.path = path;
    const std::string name = path.substr(path.find_last_of('/') + 1);
    const std::size_t first = name.find_last_of('_', name.find_last_of('_') - 1);
    char type[10] = {};
    Index& size = volume.size;
    if (first == std::string::npos
        || std::sscanf(name.c_str() + first, "_%dx%dx%d_%9[a-z0-9]", &size[0], &size[1], &size[2], type) != 4
        || *std::min_element(size.begin(), size.end()) < 2)
        throw std::runtime_error(path + ": the name should end in sizes and type, such as _64x64x64_uint8.raw");
    volume.bytesPerVoxel = std::string(type) == "uint8" ? 1 : std::string(type) == "uint16" ? 2 : 4;
    if (volume.bytesPerVoxel == 4 && std::string(type) != "float32")
        throw std::runtime_error(path + ": voxels are uint8, uint16 or float32");
    return volume;
}

// How near a point is to a trefoil knot, from 1 on the knot to 0 far away.
float knot(float x, float y, float z)
{
    static const auto points = [] {
        std::array<dfb::Vec3, 180> all;
        for (std::size_t i = 0; i < all.size(); ++i) {
            const float t = 6.2831853f * static_cast<float>(i) / 180;
            all[i] = {12 * (std::sin(t) + 2 * std::sin(2 * t)), 12 * (std::cos(t) - 2 * std::cos(2 * t)),
                      -14 * std::sin(3 * t)};
        }
        return all;
    }();
    float nearest = std::numeric_limits<float>::max();
    for (const dfb::Vec3& point : points) {
        const dfb::Vec3 way = dfb::Vec3{x - 48, y - 48, z - 48} - point;
        nearest = std::min(nearest, dot(way, way));
    }
    return std::exp(-nearest / 60);
}

// The voxels of one brick and its ghost voxels.
class BrickVoxels {
public:
    // The brick is cells [lower, upper) of the volume. Reads from the file only these voxels and the ghosts.
    BrickVoxels(const Volume& volume, const Index& lower, const Index& upper)
    {
        for (std::size_t a = 0; a < 3; ++a) {
            first_[a] = std::max(lower[a] - ghost, 0);
            size_[a] = std::min(upper[a] + ghost, volume.size[a] - 1) + 1 - first_[a];
        }
        values_.resize(std::size_t(size_[0]) * std::size_t(size_[1]) * std::size_t(size_[2]));
        std::ifstream file(volume.path, std::ios::binary);
        const std::int64_t bytes =
            std::int64_t(volume.size[0]) * volume.size[1] * volume.size[2] * volume.bytesPerVoxel;
        if (!volume.path.empty() && (!file.seekg(0, std::ios::end) || file.tellg() != bytes))
            throw std::runtime_error(volume.path + ": cannot be read, or does not have the size that its name says");
        std::vector<char> row(static_cast<std::size_t>(size_[0] * volume.bytesPerVoxel));
        float* to = values_.data();
        for (int z = first_[2]; z < first_[2] + size_[2]; ++z)
            for (int y = first_[1]; y < first_[1] + size_[1]; ++y) {
                if (!volume.path.empty()) {
                    const std::int64_t before = std::int64_t(z) * volume.size[1] + y;
                    file.seekg((before * volume.size[0] + first_[0]) * volume.bytesPerVoxel);
                    if (!file.read(row.data(), static_cast<std::streamsize>(row.size())))
                        throw std::runtime_error(volume.path + ": cannot be read");
                }
                for (int x = 0; x < size_[0]; ++x)
                    *to++ = volume.path.empty() ? knot(float(first_[0] + x), float(y), float(z))
                                                : valueAt(row.data() + x * volume.bytesPerVoxel, volume.bytesPerVoxel);
            }
    }

    // The least and the greatest value, of those that are finite.
    std::pair<float, float> range() const
    {
        std::pair<float, float> ends{std::numeric_limits<float>::max(), std::numeric_limits<float>::lowest()};
        for (const float value : values_)
            if (std::isfinite(value))
                ends = {std::min(ends.first, value), std::max(ends.second, value)};
        return ends;
    }

    // Trilinear interpolation. Beyond the border of the volume the values of the outermost voxels continue.
    float at(const dfb::Vec3& p) const
    {
        const float position[3] = {p.x, p.y, p.z};
        std::size_t corner = 0, stride = 1, step[3];
        float part[3];
        for (std::size_t a = 0; a < 3; ++a) {
            const float local = std::clamp(position[a] - float(first_[a]), 0.0f, float(size_[a] - 1));
            const int cell = std::min(int(local), size_[a] - 2);
            part[a] = local - float(cell);
            step[a] = stride;
            corner += std::size_t(cell) * stride;
            stride *= std::size_t(size_[a]);
        }
        const auto mix = [](float a, float b, float t) { return a + t * (b - a); };
        const auto edge = [&](std::size_t i) { return mix(values_[i], values_[i + step[0]], part[0]); };
        const auto face = [&](std::size_t i) { return mix(edge(i), edge(i + step[1]), part[1]); };
        return mix(face(corner), face(corner + step[2]), part[2]);
    }

    dfb::Vec3 gradientAt(const dfb::Vec3& p) const
    {
        const dfb::Vec3 x{1, 0, 0}, y{0, 1, 0}, z{0, 0, 1};
        return {at(p + x) - at(p - x), at(p + y) - at(p - y), at(p + z) - at(p - z)};
    }

private:
    static float valueAt(const char* voxel, int byteCount)
    {
        std::uint16_t word = static_cast<unsigned char>(*voxel);
        float real = 0;
        if (byteCount == 2)
            std::memcpy(&word, voxel, sizeof word);
        if (byteCount == 4)
            std::memcpy(&real, voxel, sizeof real);
        return byteCount == 4 ? real : float(word);
    }

    Index first_, size_;
    std::vector<float> values_;
};

double numberOf(const char* text)
{
    char* end = nullptr;
    const double number = std::strtod(text, &end);
    if (end == text || *end != '\0')
        throw std::runtime_error(std::string(text) + " is not a number");
    return number;
}

// Cuts the cells [lower, upper) into `count` bricks, or fewer if cells run out, always across the longest side. Calls
// `use(id, lower, upper)`.
template <class Use>
void cut(const Index& lower, const Index& upper, int id, int count, const Use& use)
{
    std::size_t axis = 0;
    for (std::size_t a = 1; a < 3; ++a)
        if (upper[a] - lower[a] > upper[axis] - lower[axis])
            axis = a;
    const int cells = upper[axis] - lower[axis], half = count / 2;
    if (count == 1 || cells < 2) {
        use(id, lower, upper);
        return;
    }
    Index middle = lower, end = upper;
    middle[axis] = end[axis] = lower[axis] + std::clamp(int(std::int64_t(cells) * half / count), 1, cells - 1);
    cut(lower, end, id, half, use);
    cut(middle, upper, id + half, count - half, use);
}

// Collects light along a ray within a brick. Samples lie at fixed distances from the eye, and each is in one brick
// only.
struct RayCaster {
    const BrickVoxels& voxels;
    dfb::Box3 bounds;
    float lowest, highest; // of the whole volume
    float from;            // lower values are transparent; 0 is `lowest`, 1 `highest`
    static constexpr float step = 0.5f;

    void operator()(const dfb::Vec3& eye, const dfb::Vec3& direction, float* rgba, float& depth) const
    {
        float enter = 0, leave = std::numeric_limits<float>::max();
        const auto clip = [&](float start, float way, float lower, float upper) {
            const float a = (lower - start) / way, b = (upper - start) / way;
            enter = std::fmax(enter, std::fmin(a, b));
            leave = std::fmin(leave, std::fmax(a, b));
        };
        clip(eye.x, direction.x, bounds.lower.x, bounds.upper.x);
        clip(eye.y, direction.y, bounds.lower.y, bounds.upper.y);
        clip(eye.z, direction.z, bounds.lower.z, bounds.upper.z);
        for (float i = std::floor(enter / step) - 1; i * step < leave + step && rgba[3] < 0.9999f; ++i) {
            const dfb::Vec3 p = eye + i * step * direction;
            if (p.x < bounds.lower.x || p.y < bounds.lower.y || p.z < bounds.lower.z || p.x >= bounds.upper.x
                || p.y >= bounds.upper.y || p.z >= bounds.upper.z)
                continue;
            const float value = (voxels.at(p) - lowest) / (highest - lowest);
            const float opacity = 1 - std::exp(-step * std::fmax(value - from, 0.0f));
            if (!(opacity > 0))
                continue;
            const dfb::Vec3 gradient = voxels.gradientAt(p);
            const float slope = std::sqrt(dot(gradient, gradient)) + 1e-6f * (highest - lowest);
            const float facing = std::fmax(std::fabs(dot(gradient, direction)) / slope, 0.0f); // 0 beside a NaN
            const float light = 0.35f + 0.65f * facing;
            const float color[3] = {0.1f + 0.9f * value, 0.3f + 0.15f * value, 0.9f - 0.85f * value}; // blue to orange
            const float visible = (1 - rgba[3]) * opacity;
            for (int c = 0; c < 3; ++c)
                rgba[c] += visible * light * color[c];
            rgba[3] += visible;
            depth = std::fmin(depth, i * step); // of the first sample
        }
    }
};

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {width, height, dfb::OutputFormat::SRGBA8});

    if (argc > 1 && argv[1][0] == '-') {
        if (fb.isDisplayRank())
            std::printf("usage: raycast [VOLUME [FROM [BRICKS]]]\n"
                        "  VOLUME  name_XxYxZ_TYPE.raw, TYPE: uint8, uint16 or float32 (default: a knot)\n"
                        "  FROM    values below this are transparent: 0 is the least value of the volume, 1 the\n"
                        "          greatest (default: 0.15)\n"
                        "  BRICKS  number of bricks (default: 8)\n"
                        "e.g.   mpirun -n 4 raycast head_256x256x128_uint8.raw 0.2\n");
        return 0;
    }
    const Volume volume = argc > 1 ? volumeOf(argv[1]) : Volume();
    const auto from = float(argc > 2 ? numberOf(argv[2]) : 0.15);
    const double count = argc > 3 ? numberOf(argv[3]) : 8;
    if (!(count >= 1 && count <= 1e6))
        throw std::runtime_error("the number of bricks is 1 to 1000000");

    int bricksOfAll = 0;
    std::vector<dfb::Brick> bricks; // of this rank
    std::vector<BrickVoxels> voxels;
    const Index last{volume.size[0] - 1, volume.size[1] - 1, volume.size[2] - 1};
    cut({0, 0, 0}, last, 0, int(count), [&](int id, const Index& lower, const Index& upper) {
        ++bricksOfAll;
        if (id % fb.size() != fb.rank())
            return;
        const auto point = [](const Index& i) { return dfb::Vec3{float(i[0]), float(i[1]), float(i[2])}; };
        bricks.push_back({static_cast<std::uint32_t>(id), {point(lower), point(upper)}});
        voxels.emplace_back(volume, lower, upper);
    });
    float range[2] = {std::numeric_limits<float>::max(), std::numeric_limits<float>::max()}; // least, and -greatest
    for (const BrickVoxels& brick : voxels) {
        range[0] = std::min(range[0], brick.range().first);
        range[1] = std::min(range[1], -brick.range().second);
    }
    MPI_Allreduce(MPI_IN_PLACE, range, 2, MPI_FLOAT, MPI_MIN, mpi.communicator());
    if (range[0] > -range[1])
        throw std::runtime_error(volume.path + ": no value is finite");

    const dfb::Vec3 center = 0.5f * dfb::Vec3{float(last[0]), float(last[1]), float(last[2])};
    const float away = 2.2f * std::sqrt(dot(center, center));
    const dfb::PerspectiveCamera camera(center + away * normalize(dfb::Vec3{0.5f, 0.6f, 1.5f}), center, {0, 1, 0}, 38);

    const dfb::World world(bricks);
    dfb::DataParallelLoop loop(fb, world);
    dfb::FrameConfig frame;
    frame.background = {0.02f, 0.02f, 0.03f, 1};
    const auto render = [&](const dfb::Brick& brick, auto& tile) {
        const auto index = static_cast<std::size_t>(&brick - world.bricks().data());
        const RayCaster cast{voxels[index], brick.bounds, range[0], -range[1], from};
        tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
            cast(camera.eye(), camera.direction(x + 0.5, y + 0.5, width, height), rgba, depth);
        });
    };
    const dfb::FrameReport report = loop.render(camera, render, frame);
    if (fb.isDisplayRank()) {
        dfb::writePpm("raycast.ppm", fb.image());
        std::printf("wrote raycast.ppm: %d bricks on %d ranks, %.0f ms\n", bricksOfAll, fb.size(), report.totalMs);
    }
} catch (const std::exception& e) {
    std::fprintf(stderr, "raycast: %s\n", e.what());
    return 1;
}
