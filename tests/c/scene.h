/* What a rank gives to pictures, in C99 and in C++: images of ellipses, and bricks with a ball in each. No number
   depends on the language: there is no function of math.h but sqrtf(), which is exact. */
#ifndef DFB_TESTS_C_SCENE_H
#define DFB_TESTS_C_SCENE_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>

enum { scene_width = 150, scene_height = 90, other_width = 70, other_height = 130, most_pixels = 150 * 130 };

/* 0 to 255, as if by chance. */
static inline int scene_number(int rank, int x, int y, int channel)
{
    uint32_t v = (uint32_t)(rank * 7919 + x * 104729 + y * 1299709 + channel * 15485863 + 12345);
    v ^= v >> 13;
    v *= 2654435761u;
    return (int)((v >> 16) & 255);
}

/* A rank's ellipse: 1 where it has something. */
static inline int scene_is_in(int rank, int x, int y, int width, int height)
{
    const int dx = x - width * (2 + rank % 3) / 6, dy = y - height * (1 + rank % 4) / 5;
    return dx * dx * 4 + dy * dy * 9 < width * height;
}

/* 8-bit premultiplied pixels and depths as OpenGL has them: 1 where there is nothing. */
static inline void scene_bytes(int rank, int width, int height, uint8_t* rgba, float* depth)
{
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const int i = y * width + x, is_in = scene_is_in(rank, x, y, width, height);
            const int alpha = is_in ? scene_number(rank, x, y, 3) : 0;
            for (int c = 0; c < 3; ++c)
                rgba[4 * i + c] = (uint8_t)(scene_number(rank, x, y, c) * alpha / 255);
            rgba[4 * i + 3] = (uint8_t)alpha;
            depth[i] = is_in ? (float)(scene_number(rank, x / 8, y / 8, 4) + 1) / 512 : 1.0f;
        }
}

/* Premultiplied floats, without depths. */
static inline void scene_floats(int rank, int width, int height, float* rgba)
{
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const int i = y * width + x, is_in = scene_is_in(rank, x, y, width, height);
            const float alpha = is_in ? (float)scene_number(rank, x, y, 3) / 255 : 0.0f;
            for (int c = 0; c < 3; ++c)
                rgba[4 * i + c] = alpha * ((float)scene_number(rank, x, y, c) / 200);
            rgba[4 * i + 3] = alpha;
        }
}

/* Two bricks a rank, side by side and behind those of lower ranks: the unit box around this point. */
static inline void scene_center(int rank, int brick, float center[3])
{
    center[0] = 1.25f * (float)brick - 0.75f + 0.25f * (float)rank;
    center[1] = 0.375f * (float)(rank % 3) - 0.25f;
    center[2] = -1.5f * (float)rank;
}
static inline void scene_bounds(int rank, int brick, float lower[3], float upper[3])
{
    float center[3];
    scene_center(rank, brick, center);
    for (int c = 0; c < 3; ++c) {
        lower[c] = center[c] - 0.5f;
        upper[c] = center[c] + 0.5f;
    }
}

/* The picture shows [-2, 2] x [-1.5, 1.5], seen along -z from z = 8. */
static const double scene_view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -8, 1};
static const double scene_projection[16] = {0.5, 0, 0, 0, 0, 1 / 1.5, 0, 0, 0, 0, -0.01, 0, 0, 0, -1, 1};

/* Draws the ball in a brick into pixels [x0, x1) x [y0, y1). */
static inline void scene_draw(uint32_t id, int x0, int y0, int x1, int y1, int width, int height, ptrdiff_t row_pixels,
                              float* rgba, float* depth)
{
    float center[3];
    scene_center((int)(id / 2), (int)(id % 2), center);
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const ptrdiff_t i = (y - y0) * row_pixels + (x - x0);
            const float dx = 4 * (((float)x + 0.5f) / (float)width) - 2 - center[0];
            const float dy = 1.5f - 3 * (((float)y + 0.5f) / (float)height) - center[1];
            const float inside = 0.25f - dx * dx - dy * dy;
            if (inside <= 0)
                continue;
            const float way = sqrtf(inside);
            rgba[4 * i + 3] = 1.5f * way;
            for (int c = 0; c < 3; ++c)
                rgba[4 * i + c] = rgba[4 * i + 3] * ((float)((id * 5 + (uint32_t)c * 3) % 8) / 8);
            depth[i] = 8 - (center[2] + way);
        }
}

#endif
