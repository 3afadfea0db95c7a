// Renderer: renders one brick into one tile at a time.
//
// Everything that several bricks must agree on is a pure function of the scene and the pixel: where the ray goes,
// where its samples are, whose a sample or a hit is (that of the half-open cell that its point is in). So the image
// does not depend on how the scene was cut.
#pragma once

#include "camera.hpp"
#include "surfaces.hpp"
#include "volume_sampler.hpp"

#if defined(__SSE2__) || defined(_M_X64)
#include <xmmintrin.h>
#endif

namespace example {

struct RenderSettings {
    int width = 1, height = 1; // of the image, in pixels
    int frames = 1;            // of one turn of the camera
    int passes = 1;            // samples per pixel
    std::uint64_t seed = 0;
    float opacity = 0.6f;       // of a surface or sphere
    float earlyTermination = 0; // a ray ends when less than this passes through it; 0: never
    View view;
};

// What a renderer needs to know of the whole scene.
struct SceneInfo {
    Box bounds;
    Box focus;      // where the camera looks
    float step = 0; // between the samples of a ray, in world space: half a voxel of the finest volume

    explicit SceneInfo(const Scene& scene)
        : bounds(scene.bounds), focus(scene.focus), step(scene.bounds.largestExtent())
    {
        for (const VolumeObject& volume : scene.volumes)
            step = std::min(step, 0.5f * volume.placement.size());
        step = std::max(step, bounds.largestExtent() * 0x1.0p-17f); // a tiny volume far from all else
    }
};

// The same on all ranks, with or without a brick.
inline Camera frameCamera(const SceneInfo& scene, const RenderSettings& settings, int frameIndex)
{
    return orbitCamera(scene.focus, settings.view, frameIndex, settings.frames, settings.width, settings.height);
}

class Renderer {
public:
    // Throws std::runtime_error if Embree does. A brick from loadBrick().
    Renderer(Brick brick, const SceneInfo& scene, const RenderSettings& settings)
        : settings_(settings), scene_(scene), cell_(brick.cell),
          surfaces_(brick.cell, std::move(brick.meshes), std::move(brick.spheres))
    {
        volumes_.reserve(brick.volumes.size());
        for (BrickVolume& volume : brick.volumes)
            volumes_.emplace_back(std::move(volume), scene.step);
    }

    // Renders the brick into tile.color and tile.depth (tile.region, tile.pass); the tile comes cleared, and pixels
    // where the brick has nothing stay so. From any number of threads.
    template <class Tile>
    void renderTile(Tile& tile, int frameIndex) const
    {
        render({tile.region.x0, tile.region.y0, tile.region.x1, tile.region.y1}, tile.pass, frameIndex, Tile::size,
               tile.color, tile.depth);
    }

private:
    struct Pixels {
        int x0, y0, x1, y1;
    };

    // Denormals flushed to zero, as Embree wants it, for as long as this lives.
    class FlushDenormals {
    public:
#if defined(__SSE2__) || defined(_M_X64)
        FlushDenormals() : before_(_mm_getcsr()) { _mm_setcsr(before_ | 0x8040u); }
        ~FlushDenormals() { _mm_setcsr(before_); }

    private:
        unsigned before_;
#else
        FlushDenormals() {}
        ~FlushDenormals() {}
#endif
    public:
        FlushDenormals(const FlushDenormals&) = delete;
        FlushDenormals& operator=(const FlushDenormals&) = delete;
    };

    // What has been gathered along a ray so far.
    struct Accumulator {
        double r = 0, g = 0, b = 0, alpha = 0, through = 1;
        float depth = std::numeric_limits<float>::infinity();

        void add(float t, float red, float green, float blue, float opacity)
        {
            if (!(opacity > 0))
                return;
            if (alpha == 0)
                depth = t;
            r += through * static_cast<double>(red);
            g += through * static_cast<double>(green);
            b += through * static_cast<double>(blue);
            alpha += through * static_cast<double>(opacity);
            through *= 1 - static_cast<double>(opacity);
        }
    };

    // Where a ray is in one volume: the next sample it has to look at, and the one behind the last.
    struct VolumeRay {
        int next = 0, end = 0;
        Vec3 inverseStep;
    };

    // One function for all tile types and so one machine code for all bricks.
    void render(const Pixels& region, int pass, int frameIndex, int stride, float* color, float* depth) const
    {
        if (volumes_.empty() && surfaces_.empty())
            return;
        const FlushDenormals flush;
        const Camera view = frameCamera(scene_, settings_, frameIndex);
        const Light light{normalize(view.forward * -0.75f + view.up * 0.55f + view.right * -0.40f)};
        std::vector<Hit> hits;
        std::vector<VolumeRay> rays(volumes_.size());
        for (int y = region.y0; y < region.y1; ++y)
            for (int x = region.x0; x < region.x1; ++x) {
                double sx = x + 0.5, sy = y + 0.5;
                if (settings_.passes > 1)
                    jitter(x, y, pass, frameIndex, sx, sy);
                const Vec3 direction = view.direction(sx, sy, settings_.width, settings_.height);
                const Accumulator sum = trace(view.origin, direction, light, hits, rays);
                if (sum.alpha == 0)
                    continue;
                const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(y - region.y0) * stride + (x - region.x0);
                color[4 * at] = static_cast<float>(sum.r);
                color[4 * at + 1] = static_cast<float>(sum.g);
                color[4 * at + 2] = static_cast<float>(sum.b);
                color[4 * at + 3] = static_cast<float>(sum.alpha);
                depth[at] = sum.depth;
            }
    }

    // A low-discrepancy sequence over the passes (the R2 sequence of Roberts), shifted by a hash of the pixel.
    void jitter(int x, int y, int pass, int frameIndex, double& sx, double& sy) const
    {
        const std::uint64_t pixel = (static_cast<std::uint64_t>(y) << 32) | static_cast<std::uint32_t>(x);
        const std::uint64_t key = hash64(hash64(settings_.seed, static_cast<std::uint64_t>(frameIndex)), pixel);
        const double u = unitReal(key) + 0.7548776662466927 * pass;
        const double v = unitReal(hash64(key)) + 0.5698402909980532 * pass;
        sx = x + (u - std::floor(u));
        sy = y + (v - std::floor(v));
    }

    // The distances at which a ray enters and leaves a box; false if it misses.
    static bool clip(const Box& box, const Vec3& origin, const Vec3& inverse, float& enter, float& leave)
    {
        enter = 0;
        leave = std::numeric_limits<float>::max();
        for (int i = 0; i < 3; ++i) {
            const float a = (box.lo[i] - origin[i]) * inverse[i], b = (box.hi[i] - origin[i]) * inverse[i];
            if (std::isnan(a) || std::isnan(b))
                continue; // 0 * infinity, of a ray within a face, limits nothing
            enter = std::max(enter, std::min(a, b));
            leave = std::min(leave, std::max(a, b));
        }
        return enter <= leave;
    }

    Accumulator trace(const Vec3& origin, const Vec3& direction, const Light& light, std::vector<Hit>& hits,
                      std::vector<VolumeRay>& rays) const
    {
        Accumulator sum;
        const Vec3 inverse(1 / direction.x, 1 / direction.y, 1 / direction.z);
        float enter = 0, leave = 0;
        // Wider than the cell by more than rounding: it is the points that decide.
        const Box reach = cell_.padded(1e-5f * (scene_.bounds.largestExtent() + length(origin)));
        if (!clip(reach, origin, inverse, enter, leave))
            return sum;
        surfaces_.intersect(origin, direction, hits);
        const int none = std::numeric_limits<int>::max();
        for (std::size_t i = 0; i < volumes_.size(); ++i) {
            float first = 0, last = 0;
            const Box box = volumes_[i].bounds().padded(2 * scene_.step);
            rays[i] = {none, none, {}};
            if (!clip(box, origin, inverse, first, last))
                continue;
            first = std::max(first, enter);
            last = std::min(last, leave);
            if (first > last)
                continue;
            rays[i].next = std::max(1, static_cast<int>(first / scene_.step) - 1);
            rays[i].end = static_cast<int>(last / scene_.step) + 2;
            rays[i].inverseStep = volumes_[i].inverseAdvance(inverse, scene_.step);
        }

        auto hit = hits.begin();
        const auto addHits = [&](float before) {
            for (; hit != hits.end() && hit->t <= before; ++hit) {
                const Vec3 c = light.shade(hit->color, hit->normal, direction) * settings_.opacity;
                sum.add(hit->t, c.x, c.y, c.z, settings_.opacity);
            }
        };
        const double least = static_cast<double>(settings_.earlyTermination);
        for (;;) {
            int k = none;
            for (const VolumeRay& ray : rays)
                k = std::min(k, ray.next < ray.end ? ray.next : none);
            if (k == none)
                break;
            // All bricks take their samples from one grid along the ray.
            const float t = static_cast<float>(k) * scene_.step;
            const Vec3 point = pointAt(origin, direction, t);
            const bool mine = cell_.contains(point);
            for (std::size_t i = 0; i < rays.size(); ++i) {
                if (rays[i].next != k)
                    continue;
                rays[i].next = k + 1;
                const VolumeSampler& volume = volumes_[i];
                const Vec3 voxel = volume.toVoxel(point);
                if (!mine || !volume.inDomain(voxel))
                    continue;
                const int skip = volume.emptySteps(voxel, rays[i].inverseStep);
                if (skip > 0) {
                    rays[i].next = k + skip;
                    continue;
                }
                const TransferFunction::Entry entry = volume.shade(voxel, direction, light);
                if (entry.alpha > 0) {
                    addHits(t);
                    sum.add(t, entry.r, entry.g, entry.b, entry.alpha);
                }
            }
            if (sum.through < least)
                return sum;
        }
        addHits(std::numeric_limits<float>::infinity());
        return sum;
    }

    RenderSettings settings_;
    SceneInfo scene_;
    Box cell_;
    Surfaces surfaces_;
    std::vector<VolumeSampler> volumes_;
};

} // namespace example
