// renderBall: a glass ball, for the small examples.
#pragma once

#include <dfb/image.hpp>
#include <dfb/render/world.hpp>

#include <cmath>

namespace example {

struct Ball {
    dfb::Vec3 center, color;
    float radius = 1;

    dfb::Box3 bounds() const
    {
        const dfb::Vec3 half{radius, radius, radius};
        return {center - half, center + half};
    }
};

// Ball `number` of a spiral around the y axis.
inline Ball ballOf(int number)
{
    const auto i = static_cast<float>(number);
    const float angle = 0.9f * i, hue = 2.1f * i;
    return {{1.6f * std::cos(angle), 0.35f * i - 1.2f, 1.6f * std::sin(angle)},
            {0.55f + 0.45f * std::cos(hue), 0.55f + 0.45f * std::cos(hue - 2.1f), 0.55f + 0.45f * std::cos(hue + 2.1f)},
            0.9f};
}

// Computes the distances along a ray at which it enters and leaves a ball. Returns false if the ray misses.
inline bool hits(const Ball& ball, const dfb::Vec3& eye, const dfb::Vec3& direction, float& enter, float& leave)
{
    const dfb::Vec3 way = ball.center - eye;
    const float middle = dot(direction, way), square = ball.radius * ball.radius - dot(way, way) + middle * middle;
    if (square <= 0)
        return false;
    enter = middle - std::sqrt(square);
    leave = middle + std::sqrt(square);
    return true;
}

// Sets the colour and depth of a pixel whose ray goes through the ball. Leaves them as they are if the ray misses.
inline void renderBall(const Ball& ball, const dfb::Vec3& eye, const dfb::Vec3& direction, float* rgba, float& depth)
{
    float enter = 0, leave = 0;
    if (!hits(ball, eye, direction, enter, leave))
        return;
    rgba[3] = 1 - std::exp(-1.2f * (leave - enter) / ball.radius);
    rgba[0] = rgba[3] * ball.color.x;
    rgba[1] = rgba[3] * ball.color.y;
    rgba[2] = rgba[3] * ball.color.z;
    depth = enter;
}

} // namespace example
