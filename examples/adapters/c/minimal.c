/* The shortest complete program in C: every rank has one brick with a glass ball in it; rank 0 writes the picture.
     mpirun -n 4 minimal_c        writes minimal_c.ppm */
#include <dfb.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { width = 640, height = 320 };

static void require(int status)
{
    if (status == DFB_OK)
        return;
    fprintf(stderr, "%s\n", dfb_last_error());
    MPI_Abort(MPI_COMM_WORLD, 1);
}

/* The picture shows [-4, 4] x [-2, 2], seen along -z from z = 8. */
static int render_ball(const dfb_brick* brick, const dfb_tile* tile, void* user)
{
    const float* center = user;
    for (int y = tile->y0; y < tile->y1; ++y)
        for (int x = tile->x0; x < tile->x1; ++x) {
            const ptrdiff_t i = (y - tile->y0) * tile->row_pixels + (x - tile->x0);
            const float dx = ((float)x + 0.5f) / 80 - 4 - center[0];
            const float dy = 2 - ((float)y + 0.5f) / 80 - center[1];
            const float inside = 1 - dx * dx - dy * dy; /* half the ray's way in the ball, squared */
            if (inside <= 0)
                continue;
            const float way = sqrtf(inside);
            float* rgba = tile->rgba + 4 * i;
            rgba[0] = rgba[3] = 0.75f * way; /* premultiplied */
            rgba[1] = rgba[3] / (float)(brick->id + 1);
            tile->depth[i] = 8 - (center[2] + way);
        }
    return 0;
}

static int write_ppm(const char* path, const uint8_t* rgba)
{
    FILE* file = fopen(path, "wb");
    if (!file)
        return 0;
    fprintf(file, "P6 %d %d 255\n", width, height);
    for (int i = 0; i < width * height; ++i)
        fwrite(rgba + 4 * i, 1, 3, file);
    return fclose(file) == 0;
}

int main(int argc, char** argv)
{
    MPI_Init(&argc, &argv);
    dfb_config config;
    dfb_config_init(&config, width, height);
    dfb_framebuffer* fb = NULL;
    require(dfb_create(MPI_COMM_WORLD, &config, &fb));

    const float rank = (float)dfb_rank(fb);
    float center[3] = {rank - 1.5f, 0.3f * rank - 0.6f, -2 * rank};
    dfb_brick brick = {(uint32_t)dfb_rank(fb), {0, 0, 0}, {0, 0, 0}};
    for (int i = 0; i < 3; ++i) {
        brick.lower[i] = center[i] - 1;
        brick.upper[i] = center[i] + 1;
    }
    const double view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -8, 1};
    const double projection[16] = {0.25, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, -0.1, 0, 0, 0, -1, 1};
    require(dfb_render(fb, &brick, 1, view, projection, render_ball, center));

    int is_written = 1;
    if (dfb_is_display_rank(fb))
        is_written = write_ppm("minimal_c.ppm", dfb_image_rgba8(fb));
    dfb_destroy(fb);
    MPI_Finalize();
    return is_written ? EXIT_SUCCESS : EXIT_FAILURE;
}
