// Tracing the rays of a tile through one brick.
#include "renderer.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#if defined(__SSE2__) || defined(_M_X64)
#include <xmmintrin.h>
#endif

namespace example {

namespace {

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

float leastOpacity(const Brick& brick, const RenderSettings& settings)
{
    float least = 1;
    for (const BrickMesh& mesh : brick.meshes)
        least = std::min(least, mesh.opacity.value_or(settings.opacity));
    for (const BrickSpheres& spheres : brick.spheres)
        least = std::min(least, spheres.opacity.value_or(settings.opacity));
    return least;
}

// How many hits of at least that opacity end a ray.
std::size_t mostHits(const RenderSettings& settings, float opacity)
{
    if (settings.pathBounces > 0)
        return 1;
    double through = 1; // computed as in Ray
    for (std::size_t hits = 1; hits <= 100; ++hits) {
        through *= 1 - static_cast<double>(opacity);
        if (through <= 0 || through < static_cast<double>(settings.earlyTermination))
            return hits;
    }
    return std::numeric_limits<std::size_t>::max();
}

// Maps two numbers from 0 to 1 to a direction around a normal, with a cosine distribution.
Vec3 cosineDirection(const Vec3& normal, double u, double v)
{
    const double angle = 2 * 3.14159265358979323846 * v, r = std::sqrt(u);
    const Vec3d n = toDouble(normal);
    const Vec3d other = std::fabs(n.x) > 0.6 ? Vec3d{0, 1, 0} : Vec3d{1, 0, 0};
    const Vec3d a = unit(cross(n, other)), b = cross(n, a);
    return toFloat(unit(a * (r * std::cos(angle)) + b * (r * std::sin(angle)) + n * std::sqrt(1 - u)));
}

// Direction number `index` of a ray with this key.
Vec3 cosineDirection(const Vec3& normal, std::uint64_t key, int index)
{
    const std::uint64_t h = hash64(key, static_cast<std::uint64_t>(index));
    return cosineDirection(normal, unitReal(h), unitReal(hash64(h)));
}

Vec3 product(const Vec3& a, const Vec3& b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }

// Clips the piece of a ray from `enter` to `leave` to a box. Returns false if nothing is left.
bool clip(const Box& box, const Vec3& origin, const Vec3& inverse, float& enter, float& leave)
{
    for (int i = 0; i < 3; ++i) {
        const float from = component(origin, i), steps = component(inverse, i);
        const float a = (component(box.lo, i) - from) * steps, b = (component(box.hi, i) - from) * steps;
        if (std::isnan(a) || std::isnan(b))
            continue; // 0 * infinity: a ray within a face has no limit
        enter = std::max(enter, std::min(a, b));
        leave = std::min(leave, std::max(a, b));
    }
    return enter <= leave;
}

} // namespace

// A ray, and the colour gathered along it so far.
struct Renderer::Ray {
    Vec3 origin, direction;
    std::uint64_t key = 0; // see RaySample
    double r = 0, g = 0, b = 0, alpha = 0, through = 1;
    float depth = std::numeric_limits<float>::infinity(), farDepth = -std::numeric_limits<float>::infinity();
    Vec3 normal{}, albedo{}; // premultiplied
    std::uint32_t primitive = dfb::noId, instance = dfb::noId;
    std::int64_t cost = 0;

    // `opacity`: above 0. The colour is premultiplied.
    void add(float t, const Vec3& color, float opacity)
    {
        if (alpha == 0)
            depth = t;
        farDepth = t;
        r += through * static_cast<double>(color.x);
        g += through * static_cast<double>(color.y);
        b += through * static_cast<double>(color.z);
        alpha += through * static_cast<double>(opacity);
        through *= 1 - static_cast<double>(opacity);
    }
    void add(const Hit& hit, const Vec3& color, float opacity)
    {
        const float weight = static_cast<float>(through) * opacity;
        normal = normal + hit.normal * weight;
        albedo = albedo + hit.color * weight;
        if (primitive == dfb::noId) {
            primitive = hit.primitive;
            instance = hit.geometry;
        }
        add(hit.t, color, opacity);
    }
};

// The random numbers of a ray. They depend on pixel, sample, frame and seed only.
struct Renderer::RaySample {
    std::uint64_t key = 0;
    dfb::LensSample lens;
    double x = 0, y = 0; // in the image
};

// Where a ray is in one volume: the next sample it has to look at, and the one behind the last.
struct Renderer::VolumeRay {
    int next = 0, end = 0;
    Vec3 inverseStep;
    int valueOf = -1; // the sample whose value is known
    float value = 0;
};

// What the rays of a tile share: the light, and memory.
struct Renderer::Tools {
    Light light;
    std::vector<Hit> hits, scratch;
    std::vector<VolumeRay> volumes;
};

Renderer::Renderer(Brick brick, const SceneInfo& scene, const RenderSettings& settings)
    : settings_(settings), scene_(scene), cell_(brick.cell),
      mostHits_(mostHits(settings, leastOpacity(brick, settings))),
      surfaces_(brick.cell, std::move(brick.meshes), std::move(brick.spheres))
{
    looksAhead_ = ghostReach(scene, settings) > 0 && mostHits_ < std::numeric_limits<std::size_t>::max()
                  && !(cell_ == scene.bounds);
    volumes_.reserve(brick.volumes.size());
    for (BrickVolume& volume : brick.volumes)
        volumes_.emplace_back(std::move(volume), scene.step);
    for (const VolumeSampler& volume : volumes_)
        hasIsosurfaces_ |= !volume.look().isovalues.empty();
}

// One function for all tile types, so that all bricks run the same machine code.
std::int64_t Renderer::render(const Target& to, int frameIndex) const
{
    if (volumes_.empty() && surfaces_.empty())
        return 0;
    const FlushDenormals flush;
    const FrameCamera camera = frameCamera(scene_, settings_, frameIndex);
    const dfb::PerspectiveCamera& view = camera.pinhole();
    Tools tools{{unit(view.forward() * -0.75f + view.up() * 0.55f + view.right() * -0.40f)}, {}, {}, {}};
    tools.volumes.resize(volumes_.size());
    std::int64_t cost = 0;
    for (int y = to.region.y0; y < to.region.y1; ++y)
        for (int x = to.region.x0; x < to.region.x1; ++x) {
            const RaySample sample = sampleAt(x, y, to.sample, frameIndex);
            const auto [origin, direction] = camera.ray(sample.x, sample.y, sample.lens);
            if (!(dot(direction, direction) > 0))
                continue;
            Ray sum{origin, direction, sample.key};
            trace(sum, tools);
            cost += sum.cost;
            if (sum.alpha == 0)
                continue;
            const std::array<float, 4> rgba{static_cast<float>(sum.r), static_cast<float>(sum.g),
                                            static_cast<float>(sum.b), static_cast<float>(sum.alpha)};
            if (to.deep) {
                to.deep->add(x, y, {rgba, sum.depth, sum.farDepth});
                continue;
            }
            const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(y - to.region.y0) * to.stride + (x - to.region.x0);
            std::copy(rgba.begin(), rgba.end(), to.color + 4 * at);
            to.depth[at] = sum.depth;
            if (to.normal == nullptr)
                continue;
            const Vec3 position = pointAt(origin, direction, sum.depth);
            for (int i = 0; i < 3; ++i) {
                to.normal[3 * at + i] = component(sum.normal, i);
                to.albedo[3 * at + i] = component(sum.albedo, i);
                to.position[3 * at + i] = component(position, i);
            }
            to.primitiveId[at] = sum.primitive;
            to.instanceId[at] = sum.instance;
        }
    return cost;
}

// Low-discrepancy sequences over the samples (the R2 sequence of Roberts for the image, the R3 one for lens and
// time), shifted by a hash of the pixel. A single sample is in the pixel's centre, the lens's middle, the shutter's
// beginning.
Renderer::RaySample Renderer::sampleAt(int x, int y, int index, int frameIndex) const
{
    const std::uint64_t pixel = (static_cast<std::uint64_t>(y) << 32) | static_cast<std::uint32_t>(x);
    const std::uint64_t key = hash64(hash64(settings_.seed, static_cast<std::uint64_t>(frameIndex)), pixel);
    RaySample sample;
    sample.key = hash64(key, static_cast<std::uint64_t>(index) + 1);
    sample.x = x + 0.5;
    sample.y = y + 0.5;
    if (settings_.passes <= 1)
        return sample;
    const auto at = [index](double shift, double step) {
        const double v = shift + step * index;
        return v - std::floor(v);
    };
    const std::uint64_t second = hash64(key), third = hash64(second), fourth = hash64(third);
    sample.x = x + at(unitReal(key), 0.7548776662466927);
    sample.y = y + at(unitReal(second), 0.5698402909980532);
    sample.lens = {at(unitReal(third), 0.8191725133961644), at(unitReal(fourth), 0.6710436067037893),
                   at(unitReal(hash64(fourth)), 0.5497004779019703)};
    return sample;
}

// The part of the sky that a hit sees, if only what is within reach can hide it. Directions follow the R2 sequence of
// Roberts, which has less noise than random ones. Everything that the brick has counts, in its cell or not.
float Renderer::openness(const Hit& hit, const Vec3& point, const Vec3& direction, std::uint64_t key) const
{
    const Vec3 normal = dot(hit.normal, direction) > 0 ? hit.normal * -1.0f : hit.normal;
    const float reach = ghostReach(scene_, settings_), least = 1e-3f * reach;
    const std::uint64_t own = hash64(key, (static_cast<std::uint64_t>(hit.geometry) << 32) | hit.primitive);
    const double first = unitReal(own), second = unitReal(hash64(own));
    const auto at = [](double shift, double step, int i) {
        const double v = shift + step * i;
        return v - std::floor(v);
    };
    int open = 0;
    for (int i = 0; i < settings_.aoRays; ++i) {
        const Vec3 ray = cosineDirection(normal, at(first, 0.7548776662466927, i), at(second, 0.5698402909980532, i));
        open += !surfaces_.occluded(point, ray, least, reach);
    }
    return static_cast<float>(open) / static_cast<float>(settings_.aoRays);
}

// Diffuse light from a bright sky, over the bounces of one path that begins at a hit. Volumes are left out.
Vec3 Renderer::pathLight(Hit hit, Vec3 point, Vec3 direction, std::uint64_t key, std::vector<Hit>& hits,
                         std::int64_t& cost) const
{
    Vec3 through = hit.color;
    const float least = 1e-4f * scene_.bounds.largestExtent();
    for (int bounce = 0; bounce < settings_.pathBounces; ++bounce) {
        const Vec3 normal = dot(hit.normal, direction) > 0 ? hit.normal * -1.0f : hit.normal;
        direction = cosineDirection(normal, key, bounce);
        const Vec3 origin = point + normal * least;
        surfaces_.intersect(origin, direction, hits, 1);
        ++cost;
        if (hits.empty()) {
            const float sky = 0.9f + 0.5f * dot(direction, unit(settings_.view.up)); // brighter above
            return product(through, Vec3{sky, sky, 1.05f * sky});
        }
        hit = hits.front();
        point = pointAt(origin, direction, hit.t);
        through = product(through, hit.color);
    }
    return Vec3{0, 0, 0};
}

void Renderer::trace(Ray& ray, Tools& tools) const
{
    const Vec3 &origin = ray.origin, &direction = ray.direction;
    const Vec3 inverse{1 / direction.x, 1 / direction.y, 1 / direction.z};
    float enter = 0, leave = std::numeric_limits<float>::max();
    // Wider than the cell by more than rounding, because each point is tested again later.
    const Box reach = cell_.padded(1e-5f * (scene_.bounds.largestExtent() + length(origin)));
    if (!clip(reach, origin, inverse, enter, leave))
        return;
    ray.cost = 1;
    std::vector<Hit>& hits = tools.hits;
    surfaces_.intersect(origin, direction, hits, mostHits_);
    if (hits.size() == mostHits_)
        leave = std::min(leave, hits.back().t);
    if (looksAhead_ && !hits.empty()) {
        ++ray.cost;
        if (surfaces_.blocks(origin, direction, enter, mostHits_, tools.scratch))
            return;
    }
    if (settings_.pathBounces > 0) {
        if (hits.empty())
            return;
        const Hit first = hits.front();
        ray.add(first, pathLight(first, pointAt(origin, direction, first.t), direction, ray.key, hits, ray.cost), 1);
        return;
    }
    for (std::size_t i = 0; i < volumes_.size(); ++i) {
        float first = enter, last = leave;
        tools.volumes[i] = {};
        if (!clip(volumes_[i].bounds().padded(2 * scene_.step), origin, inverse, first, last))
            continue;
        tools.volumes[i].next = std::max(1, static_cast<int>(first / scene_.step) - 1);
        tools.volumes[i].end = static_cast<int>(last / scene_.step) + 2;
        tools.volumes[i].inverseStep = volumes_[i].inverseAdvance(direction, scene_.step);
    }
    march(ray, tools);
}

// Adds what hits and volumes show, front to back.
void Renderer::march(Ray& ray, Tools& tools) const
{
    auto hit = tools.hits.cbegin();
    const double least = static_cast<double>(settings_.earlyTermination);
    const auto isDone = [&] { return ray.through <= 0 || ray.through < least; };
    const auto addHits = [&](float before) {
        for (; hit != tools.hits.cend() && hit->t <= before && !isDone(); ++hit)
            addHit(ray, *hit, tools.light);
    };
    while (!isDone()) {
        const int none = std::numeric_limits<int>::max();
        int k = none;
        for (const VolumeRay& volume : tools.volumes)
            k = std::min(k, volume.next < volume.end ? volume.next : none);
        if (k == none)
            break;
        // All bricks take their samples from one grid along the ray.
        const float t = static_cast<float>(k) * scene_.step;
        const Vec3 point = pointAt(ray.origin, ray.direction, t);
        const bool mine = cell_.contains(point);
        if (hasIsosurfaces_) {
            findCrossings(ray.origin, ray.direction, k, tools.volumes, tools.scratch);
            for (const Hit& crossing : tools.scratch) {
                addHits(crossing.t);
                if (!isDone())
                    addHit(ray, crossing, tools.light);
            }
            if (isDone())
                break;
        }
        for (std::size_t i = 0; i < volumes_.size(); ++i) {
            VolumeRay& along = tools.volumes[i];
            if (along.next != k)
                continue;
            along.next = k + 1;
            const VolumeSampler& volume = volumes_[i];
            const Vec3 voxel = volume.toVoxel(point);
            if (!mine || !volume.inDomain(voxel))
                continue;
            if (const int skip = volume.emptySteps(voxel, along.inverseStep); skip > 0) {
                along.next = k + skip;
                continue;
            }
            ++ray.cost;
            const Shaded shaded = volume.shade(voxel, ray.direction, tools.light);
            if (shaded.alpha > 0) {
                addHits(t);
                if (isDone())
                    break;
                ray.albedo = ray.albedo + shaded.albedo * static_cast<float>(ray.through);
                ray.add(t, shaded.color, shaded.alpha);
            }
        }
    }
    addHits(std::numeric_limits<float>::infinity());
}

// Adds the light of a surface, which is less where others are near.
void Renderer::addHit(Ray& ray, const Hit& hit, const Light& light) const
{
    const float opacity = hit.opacity.value_or(settings_.opacity);
    if (!(opacity > 0))
        return;
    const Vec3 point = pointAt(ray.origin, ray.direction, hit.t);
    const float reach = ghostReach(scene_, settings_); // also beyond the cell
    Vec3 c = light.shade(hit.color, hit.normal, ray.direction) * opacity;
    if (!surfaces_.empty()) { // isosurfaces neither cast shadows nor hide the sky
        if (settings_.shadows && surfaces_.occluded(point, light.direction, 1e-3f * reach, reach))
            c = hit.color * light.ambient * opacity;
        if (settings_.aoRays > 0)
            c = c * (0.3f + 0.7f * openness(hit, point, ray.direction, ray.key)); // some light comes by many bounces
        ray.cost += settings_.shadows + settings_.aoRays;
    }
    ray.add(hit, c, opacity);
}

// Finds the points in the cell where the ray meets isosurfaces between samples k - 1 and k, front to back. The samples
// may be a step outside of the cell; their values are the same in all bricks.
void Renderer::findCrossings(const Vec3& origin, const Vec3& direction, int k, std::vector<VolumeRay>& rays,
                             std::vector<Hit>& crossings) const
{
    crossings.clear();
    for (std::size_t i = 0; i < rays.size(); ++i) {
        const VolumeSampler& volume = volumes_[i];
        const VolumeLook& look = volume.look();
        if (rays[i].next != k || look.isovalues.empty())
            continue;
        const auto valueAt = [&](float t) { return volume.valueAt(volume.toVoxel(pointAt(origin, direction, t))); };
        const float t0 = static_cast<float>(k - 1) * scene_.step, t1 = static_cast<float>(k) * scene_.step;
        const float v0 = rays[i].valueOf == k - 1 ? rays[i].value : valueAt(t0), v1 = valueAt(t1);
        rays[i].valueOf = k;
        rays[i].value = v1;
        for (std::size_t n = 0; n < look.isovalues.size(); ++n) {
            const float iso = look.isovalues[n];
            if (std::isnan(v0) || std::isnan(v1) || (v0 < iso) == (v1 < iso))
                continue;
            float a = t0, b = t1, va = v0, vb = v1; // iso is between va and vb
            float t = t0;
            for (int step = 0; step < 4; ++step) {
                t = std::clamp(a + (b - a) * ((iso - va) / (vb - va)), a, b);
                const float v = valueAt(t);
                const bool isBehind = (v < iso) == (vb < iso);
                (isBehind ? b : a) = t;
                (isBehind ? vb : va) = v;
            }
            const Vec3 point = pointAt(origin, direction, t), voxel = volume.toVoxel(point);
            if (!(t > 0) || !cell_.contains(point) || !volume.inDomain(voxel))
                continue;
            Hit hit;
            hit.t = t;
            hit.geometry = volume.geometry();
            hit.primitive = static_cast<std::uint32_t>(n);
            hit.normal = volume.directionAt(voxel);
            hit.color = look.isoColors[n];
            hit.opacity = look.isoOpacity;
            crossings.push_back(hit);
        }
    }
    std::sort(crossings.begin(), crossings.end());
}

} // namespace example
