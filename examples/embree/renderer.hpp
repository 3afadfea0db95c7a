// Renderer: renders one brick into one tile at a time.
//
// Everything that several bricks must agree on is a pure function of the scene and the pixel: where the ray goes, where
// its samples are, which brick has a sample or a hit (the one whose half-open cell its point is in). So the image does
// not depend on how the scene was cut.
#pragma once

#include "camera.hpp"
#include "surfaces.hpp"
#include "volume_sampler.hpp"

#include <dfb/render/deep_parallel.hpp>

#include <algorithm>
#include <cstdint>
#include <vector>

namespace example {

// Facts about the whole scene that every renderer needs.
struct SceneInfo {
    Box bounds;
    Focus focus;    // where the camera looks
    float step = 0; // between the samples of a ray, in world space: half a voxel of the finest volume

    explicit SceneInfo(const Scene& scene)
        : bounds(scene.bounds), focus(scene.focus()), step(scene.bounds.largestExtent())
    {
        for (const VolumeObject& volume : scene.volumes)
            step = std::min(step, 0.5f * volume.placement.size());
        step = std::max(step, bounds.largestExtent() * 0x1.0p-17f); // for a tiny volume far from all else
    }
};

// The camera of a frame, the same on all ranks, also on those without a brick.
inline FrameCamera frameCamera(const SceneInfo& scene, const RenderSettings& settings, int frameIndex)
{
    return FrameCamera(scene.focus, settings.view, frameIndex, settings.frames, settings.width, settings.height);
}

// How far secondary rays reach beyond a brick's cell, in world space, and so how far the brick needs ghosts.
inline float ghostReach(const SceneInfo& scene, const RenderSettings& settings)
{
    return settings.aoRays > 0 || settings.shadows ? settings.aoDistance * scene.bounds.largestExtent() : 0;
}

class Renderer {
public:
    // Takes a brick from loadBrick(). Throws std::runtime_error if Embree fails.
    Renderer(Brick brick, const SceneInfo& scene, const RenderSettings& settings);

    // Sets view, size and passes of the tiles that are rendered from now on. Not while one is being rendered.
    void look(const RenderSettings& settings) { settings_ = settings; }

    // Renders the brick into the channels that the tile has (tile.region, tile.sample); the tile must be cleared, and
    // pixels where the brick has nothing stay so. Returns the cost: the number of volume samples and secondary rays,
    // and one for each camera ray that comes near. Any number of threads at once.
    template <class Tile>
    std::int64_t renderTile(Tile& tile, int frameIndex) const
    {
        Target to;
        to.region = tile.region;
        to.sample = tile.sample;
        to.stride = Tile::size;
        to.color = tile.color;
        to.depth = tile.depth;
        if constexpr ((Tile::channels & dfb::normalChannel) != 0) {
            to.normal = tile.normal;
            to.albedo = tile.albedo;
            to.position = tile.position;
            to.primitiveId = tile.primitiveId;
            to.instanceId = tile.instanceId;
        }
        return render(to, frameIndex);
    }

    // Renders into a tile with several segments per pixel: adds a segment to each pixel where the brick has something.
    std::int64_t renderDeep(dfb::DeepTile& deep, int frameIndex) const
    {
        Target to;
        to.region = deep.header().region;
        to.sample = deep.header().sample;
        to.deep = &deep;
        return render(to, frameIndex);
    }

private:
    // Where pixels go: to a tile's channels, of which some may be null, or to segments.
    struct Target {
        dfb::Region region;
        int sample = 0, stride = 0;
        float *color = nullptr, *depth = nullptr, *normal = nullptr, *albedo = nullptr, *position = nullptr;
        std::uint32_t *primitiveId = nullptr, *instanceId = nullptr;
        dfb::DeepTile* deep = nullptr;
    };

    struct Ray;
    struct RaySample;
    struct VolumeRay;
    struct Tools;

    std::int64_t render(const Target& to, int frameIndex) const;
    RaySample sampleAt(int x, int y, int index, int frameIndex) const;
    float openness(const Hit& hit, const Vec3& point, const Vec3& direction, std::uint64_t key) const;
    Vec3 pathLight(Hit hit, Vec3 point, Vec3 direction, std::uint64_t key, std::vector<Hit>& hits,
                   std::int64_t& cost) const;
    void trace(Ray& ray, Tools& tools) const;
    void march(Ray& ray, Tools& tools) const;
    void addHit(Ray& ray, const Hit& hit, const Light& light) const;
    void findCrossings(const Vec3& origin, const Vec3& direction, int k, std::vector<VolumeRay>& rays,
                       std::vector<Hit>& crossings) const;

    RenderSettings settings_;
    SceneInfo scene_;
    Box cell_;
    std::size_t mostHits_; // from the brick's parts, which the next member takes
    Surfaces surfaces_;
    // Whether to test first, with one ray, if ghosts hide all hits. Other bricks show the ghosts, and the hits need no
    // rays then.
    bool looksAhead_ = false;
    bool hasIsosurfaces_ = false;
    std::vector<VolumeSampler> volumes_;
};

} // namespace example
