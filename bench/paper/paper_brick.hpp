// PaperBrick: a brick of a generated scene, which can be rendered; and what its renderers have in common.
#pragma once

#include "clip.hpp"

#include <dfb/exec.hpp>
#include <dfb/image.hpp>
#include <dfb/render/visibility.hpp>
#include <dfb/render/world.hpp>

#include <algorithm>
#include <cstddef>
#include <functional>
#include <limits>
#include <memory>
#include <string>

namespace bench {

// Where pixels go: rows of `stride` pixels, of which the first is that of region.x0 and region.y0, cleared before.
// Depth may be null.
struct Pixels {
    dfb::Region region;
    int width = 0, height = 0; // of the whole image
    std::ptrdiff_t stride = 0;
    float *color = nullptr, *depth = nullptr;
};

struct Traced {
    float rgba[4] = {0, 0, 0, 0}; // premultiplied
    float depth = std::numeric_limits<float>::infinity();
    float through = 1; // of the light from behind

    // Adds a sample behind the earlier ones; the colour is not premultiplied.
    void add(float t, const dfb::Vec3& color, float alpha)
    {
        if (!(alpha > 0))
            return;
        if (rgba[3] == 0)
            depth = t;
        const float part = through * alpha;
        rgba[0] += part * color.x;
        rgba[1] += part * color.y;
        rgba[2] += part * color.z;
        rgba[3] += part;
        through *= 1 - alpha;
    }
};

// Half-open: the point alone decides which brick has it, so ranks need not ask each other.
inline bool contains(const dfb::Box3& box, const dfb::Vec3& p)
{
    return p.x >= box.lower.x && p.y >= box.lower.y && p.z >= box.lower.z && p.x < box.upper.x && p.y < box.upper.y
           && p.z < box.upper.z;
}

// The lit colour of a surface: half of the light is ambient, which `openness` (0 to 1) dims; the rest comes from a lamp
// above the viewer's shoulder.
inline dfb::Vec3 lit(const dfb::Vec3& color, dfb::Vec3 normal, const dfb::Vec3& direction, float openness)
{
    if (dot(normal, direction) > 0)
        normal = -1.0f * normal;
    const dfb::Vec3 lamp = normalize(dfb::Vec3{0.35f, 0.75f, 0.2f} - direction);
    const float diffuse = std::max(0.0f, dot(normal, lamp)),
                mirrored = std::max(0.0f, dot(normal, normalize(lamp - direction)));
    float gloss = mirrored * mirrored;
    gloss *= gloss, gloss *= gloss, gloss *= gloss;
    return (0.45f * openness + 0.6f * diffuse) * color + 0.25f * gloss * dfb::Vec3{1, 1, 1};
}

// A rank's part of a scene, within bounds, with as much of its surroundings as rays within the bounds need.
class PaperBrick {
public:
    PaperBrick() = default;
    PaperBrick(const PaperBrick&) = delete;
    PaperBrick& operator=(const PaperBrick&) = delete;
    virtual ~PaperBrick() = default;

    // What rays meet within the bounds. From several threads at once.
    virtual void render(const dfb::PerspectiveCamera& camera, const Pixels& to) const = 0;
};

// A scene in a unit cube. However it is cut into bricks, together they show the same.
struct PaperScene {
    std::string name;
    std::function<std::unique_ptr<PaperBrick>(const dfb::Box3&, dfb::Executor&)> make;
};

// Calls trace(direction, x, y) for each pixel, and stores what it returns.
template <class Trace>
void tracePixels(const dfb::PerspectiveCamera& camera, const Pixels& to, const Trace& trace)
{
    for (int y = to.region.y0; y < to.region.y1; ++y)
        for (int x = to.region.x0; x < to.region.x1; ++x) {
            const Traced traced = trace(camera.direction(x + 0.5, y + 0.5, to.width, to.height), x, y);
            if (traced.rgba[3] == 0)
                continue;
            const std::ptrdiff_t at = (y - to.region.y0) * to.stride + (x - to.region.x0);
            std::copy_n(traced.rgba, 4, to.color + 4 * at);
            if (to.depth)
                to.depth[at] = traced.depth;
        }
}

} // namespace bench
