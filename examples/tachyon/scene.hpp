// A scene of the ray tracer Tachyon, which renders any part of the image. Of dfb it uses only Region.
#pragma once

#include <dfb/image.hpp>

#include <tachyon.h>

#include <cmath>
#include <cstddef>
#include <memory>
#include <vector>

inline constexpr int imageWidth = 480, imageHeight = 320;

// Tachyon's scene: a spiral of balls over a floor that mirrors them. One thread at a time may use it.
class Scene {
public:
    Scene()
    {
        SceneHandle s = scene_.get();
        rt_set_numthreads(s, 1);
        rt_verbose(s, 0);
        rt_camera_projection(s, RT_PROJECTION_PERSPECTIVE);
        rt_camera_position(s, rt_vector(0, 5.2, -9), rt_vector(0, -0.5, 0.86), rt_vector(0, 1, 0));
        rt_camera_raydepth(s, 6);
        rt_background(s, rt_color(0.55, 0.7, 0.9));
        rt_light(s, material(1, 1, 1, 0), rt_vector(-6, 12, -8), 0.1);
        rt_plane(s, material(0.5, 0.5, 0.55, 0.25), rt_vector(0, 0, 0), rt_vector(0, 1, 0));
        for (int i = 0; i < 120; ++i) {
            const double turn = 0.26 * i, away = 0.3 + 0.035 * i, size = 0.12 + 0.0028 * i;
            void* skin = material(0.5 + 0.5 * std::cos(turn), 0.35, 0.5 + 0.5 * std::sin(0.7 * turn), 0.2);
            rt_sphere(s, skin, rt_vector(away * std::cos(turn), size, away * std::sin(turn)), size);
        }
    }

    // Renders pixels [x0, x1) x [y0, y1) of the image, sampled `right` and `up` of the middle of each pixel, in pixels.
    // Returns red, green and blue of each; the first row is the lowest.
    const std::vector<float>& render(const dfb::Region& part, double right = 0, double up = 0)
    {
        // Exact in binary, so that the rays of a tile's frustum are exactly those of the whole image.
        const double pixel = 5.0 / 2048, middleX = imageWidth / 2.0 - right, middleY = imageHeight / 2.0 + up;
        pixels_.resize(3 * static_cast<std::size_t>(part.width()) * static_cast<std::size_t>(part.height()));
        rt_resolution(scene_.get(), part.width(), part.height());
        rt_camera_frustum(scene_.get(), (part.x0 - middleX) * pixel, (part.x1 - middleX) * pixel,
                          (middleY - part.y1) * pixel, (middleY - part.y0) * pixel);
        rt_rawimage_rgb96f(scene_.get(), pixels_.data());
        rt_renderscene(scene_.get());
        return pixels_;
    }

private:
    struct Delete {
        void operator()(void* scene) const { rt_deletescene(scene); }
    };

    void* material(double r, double g, double b, double mirror)
    {
        apitexture look{};
        look.texturefunc = RT_TEXTURE_CONSTANT;
        look.col = rt_color(r, g, b);
        look.shadowcast = 1;
        look.ambient = 0.15;
        look.diffuse = 0.75;
        look.specular = mirror;
        look.opacity = 1;
        return rt_texture(scene_.get(), &look);
    }

    std::unique_ptr<void, Delete> scene_{rt_newscene()};
    std::vector<float> pixels_;
};
