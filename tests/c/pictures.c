/* A program in C99 on dfb.h:
     mpirun -n 3 test_c_pictures write FILE [multiple]
       writes pictures, which test_c_twin must make bit for bit as well
     mpirun -n 3 test_c_pictures errors [multiple]
       calls that are wrong, on one rank or on all
     mpirun -n 3 test_c_pictures lost [multiple]
       a rank that is stopped while it draws; it goes on when the others have been told
   With "multiple" at MPI_THREAD_MULTIPLE, else with plain MPI_Init. Returns 0 if all is well. */
#define _POSIX_C_SOURCE 200809L /* for SIGSTOP */
#include "scene.h"

#include <dfb.h>

#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static int rank = 0, ranks = 1, failures = 0;

static void expect(int is_fine, const char* what)
{
    if (is_fine)
        return;
    ++failures;
    fprintf(stderr, "rank %d of %d: %s; the last error: %s\n", rank, ranks, what, dfb_last_error());
}

static void require(int status, const char* what)
{
    if (status == DFB_OK)
        return;
    fprintf(stderr, "rank %d of %d: %s: %s\n", rank, ranks, what, dfb_last_error());
    MPI_Abort(MPI_COMM_WORLD, 1);
}

static uint8_t bytes[4 * most_pixels];
static float floats[4 * most_pixels], depths[most_pixels];

static FILE* file = NULL; /* of the display rank */

/* Writes what there is of the picture. */
static void write_picture(const dfb_framebuffer* fb)
{
    const size_t count = (size_t)dfb_width(fb) * (size_t)dfb_height(fb);
    const uint8_t* rgba8 = dfb_image_rgba8(fb);
    const float *rgba32f = dfb_image_rgba32f(fb), *depth = dfb_image_depth(fb);
    expect((rgba8 || rgba32f) == dfb_is_display_rank(fb), "the display rank alone has a picture");
    expect(!(rgba8 && rgba32f), "a picture has one format");
    if (!file)
        return;
    if (rgba8)
        fwrite(rgba8, 4, count, file);
    if (rgba32f)
        fwrite(rgba32f, 16, count, file);
    if (depth)
        fwrite(depth, 4, count, file);
}

static int draw(const dfb_brick* brick, const dfb_tile* tile, void* user)
{
    (void)user;
    scene_draw(brick->id, tile->x0, tile->y0, tile->x1, tile->y1, tile->width, tile->height, tile->row_pixels,
               tile->rgba, tile->depth);
    return 0;
}

static void get_bricks(dfb_brick bricks[2])
{
    for (int i = 0; i < 2; ++i) {
        bricks[i].id = (uint32_t)(2 * rank + i);
        scene_bounds(rank, i, bricks[i].lower, bricks[i].upper);
    }
}

static dfb_framebuffer* make(int blend, int format, int depth, int threads)
{
    dfb_config config;
    dfb_framebuffer* fb = NULL;
    dfb_config_init(&config, scene_width, scene_height);
    config.blend = blend;
    config.format = format;
    config.depth = depth;
    config.threads = threads;
    config.display_rank = ranks - 1;
    config.background[0] = 0.125f;
    config.background[2] = 0.5f;
    config.background[3] = 0.75f;
    require(dfb_create(MPI_COMM_WORLD, &config, &fb), "dfb_create");
    return fb;
}

/* 8-bit images with the lowest row first, as OpenGL gives them. */
static void composite_bytes(dfb_framebuffer* fb)
{
    dfb_input input;
    scene_bytes(rank, dfb_width(fb), dfb_height(fb), bytes, depths);
    dfb_input_init(&input);
    input.rgba8 = bytes;
    input.depth = depths;
    input.bottom_up = 1;
    input.far_depth = 1;
    require(dfb_composite(fb, &input, 0), "images of bytes");
    write_picture(fb);
}

/* Floats in an order of the ranks: the last one in front. */
static void composite_floats(dfb_framebuffer* fb)
{
    dfb_input input;
    scene_floats(rank, dfb_width(fb), dfb_height(fb), floats);
    dfb_input_init(&input);
    input.rgba32f = floats;
    require(dfb_composite(fb, &input, ranks - 1 - rank), "images in order");
    write_picture(fb);
}

/* A part of the picture, blue first, with straight alpha, of which a part is valid, in rows with a gap. */
static void composite_part(dfb_framebuffer* fb)
{
    dfb_input input;
    scene_bytes(rank, 100, 80, bytes, depths);
    dfb_input_init(&input);
    input.rgba8 = bytes;
    input.depth = depths;
    input.row_pixels = 100;
    input.is_bgra = 1;
    input.has_straight_alpha = 1;
    input.region[0] = 10;
    input.region[1] = 5;
    input.region[2] = 100;
    input.region[3] = 85;
    input.valid[0] = 20;
    input.valid[1] = 15;
    input.valid[2] = 90;
    input.valid[3] = 200;
    require(dfb_composite(fb, &input, 0), "a part");
    write_picture(fb);
}

static void render(dfb_framebuffer* fb)
{
    dfb_brick bricks[2];
    get_bricks(bricks);
    require(dfb_render(fb, bricks, 2, scene_view, scene_projection, draw, NULL), "bricks");
    write_picture(fb);
}

static void write_all(const char* path)
{
    if (rank == ranks - 1) {
        file = fopen(path, "wb");
        expect(file != NULL, "the file cannot be written");
    }
    for (int threads = 1; threads >= 0; --threads) {
        dfb_framebuffer* fb = make(DFB_NEAREST, DFB_RGBA8, 1, threads);
        expect(!dfb_image_rgba8(fb), "there is no picture yet");
        composite_bytes(fb);
        render(fb);
        require(dfb_resize(fb, other_width, other_height), "dfb_resize");
        expect(!dfb_image_rgba8(fb) && dfb_width(fb) == other_width && dfb_height(fb) == other_height, "resized");
        composite_bytes(fb);
        render(fb);
        dfb_destroy(fb);

        fb = make(DFB_IN_ORDER, DFB_RGBA32F, 0, threads);
        composite_floats(fb);
        dfb_destroy(fb);

        fb = make(DFB_BY_DEPTH, DFB_SRGBA8, 0, threads);
        composite_part(fb);
        render(fb);
        dfb_destroy(fb);

        fb = make(DFB_BY_DEPTH, DFB_RGBA32F, 1, threads);
        render(fb);
        dfb_report report;
        require(dfb_get_report(fb, &report), "dfb_get_report");
        expect(report.frame == 1 && report.tiles_total == 6 && report.tiles_touched > 0 && report.total_ms > 0
                   && report.threads >= 1 && report.non_finite_pixels == 0,
               "the report");
        const size_t size = 16 * (size_t)(scene_width * scene_height);
        float* all = malloc(size);
        if (dfb_is_display_rank(fb))
            memcpy(all, dfb_image_rgba32f(fb), size);
        require(dfb_image_on_all_ranks(fb), "dfb_image_on_all_ranks");
        expect(dfb_image_rgba32f(fb) && dfb_image_depth(fb), "all ranks have the picture");
        MPI_Bcast(all, (int)size, MPI_BYTE, ranks - 1, MPI_COMM_WORLD);
        expect(dfb_image_rgba32f(fb) && memcmp(all, dfb_image_rgba32f(fb), size) == 0,
               "it is that of the display rank");
        free(all);
        dfb_destroy(fb);
    }
    if (file)
        expect(fclose(file) == 0, "the file is written");
}

/* The last error has all of these; null: no more. */
static void expect_error(int status, int expected, const char* text, const char* other, const char* what)
{
    char line[300];
    snprintf(line, sizeof line, "%s: status %d, not %d, or no '%s' or '%s'", what, status, expected, text, other);
    expect(status == expected && strstr(dfb_last_error(), text) && strstr(dfb_last_error(), other), line);
}

static dfb_framebuffer* called = NULL;

/* Calls functions on the framebuffer that it is called by, on the thread that called that. */
static int draw_and_call(const dfb_brick* brick, const dfb_tile* tile, void* user)
{
    int is_main = 0;
    MPI_Is_thread_main(&is_main);
    expect(is_main, "the renderer is called by another thread");
    expect(dfb_resize(called, 10, 10) == DFB_INVALID_ARGUMENT, "dfb_resize() by a renderer");
    dfb_destroy(called);
    expect_error(DFB_OK, DFB_OK, "a renderer cannot destroy it", "", "dfb_destroy() by a renderer");
    expect(!dfb_image_rgba8(called), "no picture while one is made");
    return draw(brick, tile, user);
}

static int draw_badly(const dfb_brick* brick, const dfb_tile* tile, void* user)
{
    const int* bad = user;
    return brick->id == (uint32_t)*bad ? 42 : draw(brick, tile, NULL);
}

static void expect_picture(dfb_framebuffer* fb)
{
    dfb_brick bricks[2];
    get_bricks(bricks);
    expect(!dfb_image_rgba8(fb) && !dfb_image_depth(fb), "no picture after one that failed");
    require(dfb_render(fb, bricks, 2, scene_view, scene_projection, draw, NULL), "bricks after an error");
    expect((dfb_image_rgba8(fb) != NULL) == dfb_is_display_rank(fb), "a picture after an error");
}

static void check_creation(void)
{
    const int bad = ranks - 1; /* the rank that is wrong */
    char name[20];
    snprintf(name, sizeof name, "rank %d", bad);
    for (int wrong = 0; wrong < 9; ++wrong) {
        dfb_config config;
        dfb_framebuffer *fb = NULL, *const unset = (dfb_framebuffer*)&config;
        const dfb_config* given = &config;
        const char* text = "";
        dfb_config_init(&config, scene_width, scene_height);
        fb = unset;
        if (wrong == 0)
            config.struct_size = rank == bad ? 8 : config.struct_size, text = "dfb_config of 8 bytes";
        if (wrong == 1)
            config.blend = rank == bad ? 7 : config.blend, text = "dfb_blend 7";
        if (wrong == 2)
            config.format = rank == bad ? -1 : config.format, text = "dfb_format -1";
        if (wrong == 3)
            config.threads = rank == bad ? -2 : config.threads, text = "-2 threads";
        if (wrong == 4)
            given = rank == bad ? NULL : given, text = "a null dfb_config";
        if (wrong == 5)
            config.timeout_ms = rank == bad ? -1 : 0, text = "a timeout_ms of -1";
        if (wrong == 6)
            config.width = rank == bad ? 0 : config.width, text = "0x90";
        if (wrong == 7)
            config.display_rank = ranks, text = "the display rank is";
        if (wrong == 8) {
            if (ranks == 1)
                continue;
            config.height += rank == bad;
            text = "height";
        }
        expect_error(dfb_create(MPI_COMM_WORLD, given, &fb), DFB_INVALID_ARGUMENT, text, wrong < 7 ? name : "rank",
                     "dfb_create");
        expect(!fb, "there is no framebuffer after an error");
    }
    dfb_config config;
    dfb_framebuffer* fb = NULL;
    dfb_config_init(&config, scene_width, scene_height);
    if (rank != bad)
        fb = (dfb_framebuffer*)&config;
    expect_error(dfb_create(MPI_COMM_WORLD, &config, rank == bad ? NULL : &fb), DFB_INVALID_ARGUMENT,
                 "a null pointer to store the framebuffer at", name, "dfb_create");
    expect(!fb, "there is no framebuffer after an error");
    expect_error(dfb_create(MPI_COMM_NULL, &config, &fb), DFB_INVALID_ARGUMENT, "MPI_COMM_NULL", "", "dfb_create");
    dfb_config_init(NULL, 1, 1);
    dfb_input_init(NULL);
    dfb_destroy(NULL);
    expect(dfb_rank(NULL) == -1 && dfb_size(NULL) == -1 && dfb_width(NULL) == 0 && dfb_height(NULL) == 0
               && !dfb_is_display_rank(NULL) && !dfb_image_rgba8(NULL) && !dfb_image_rgba32f(NULL)
               && !dfb_image_depth(NULL),
           "functions that get no framebuffer");
    expect_error(dfb_resize(NULL, 1, 1), DFB_INVALID_ARGUMENT, "a null dfb_framebuffer", "", "dfb_resize");
}

static void check_render(dfb_framebuffer* fb)
{
    const int bad = ranks - 1;
    char name[20], brick[20];
    snprintf(name, sizeof name, "rank %d", bad);
    snprintf(brick, sizeof brick, "brick %d", 2 * bad + 1);
    for (int wrong = 0; wrong < 8; ++wrong) {
        dfb_brick bricks[2];
        const dfb_brick* given = bricks;
        const double *view = scene_view, *projection = scene_projection, zeros[16] = {0};
        dfb_render_brick renderer = draw;
        int count = 2, bad_brick = 2 * bad + 1;
        const char* text = "";
        get_bricks(bricks);
        if (rank == bad) {
            if (wrong == 0)
                renderer = NULL;
            if (wrong == 1)
                given = NULL;
            if (wrong == 2)
                count = -1;
            if (wrong == 3)
                view = NULL;
            if (wrong == 4)
                projection = zeros;
            if (wrong == 5)
                bricks[1].lower[2] = bricks[1].upper[2] + 1;
            if (wrong == 6)
                bricks[1].id = bricks[0].id;
        }
        if (wrong == 7)
            renderer = draw_badly;
        static const char* const texts[] = {
            "a null renderer", "a null array of bricks", "-1 bricks",       "a null matrix",
            "singular",        "are not a box",          "was added twice", "returned 42"};
        text = texts[wrong];
        expect_error(dfb_render(fb, given, count, view, projection, renderer, &bad_brick), DFB_FRAME_FAILED, text, name,
                     "dfb_render");
        expect_error(DFB_OK, DFB_OK, wrong == 7 || wrong == 5 ? brick : "", "", "dfb_render");
        expect_picture(fb);
    }
    expect(dfb_render(NULL, NULL, 0, scene_view, scene_projection, draw, NULL) == DFB_INVALID_ARGUMENT,
           "no framebuffer");
    dfb_brick bricks[2];
    get_bricks(bricks);
    called = fb;
    require(dfb_render(fb, bricks, 2, scene_view, scene_projection, draw_and_call, NULL), "a renderer that calls");
    require(dfb_render(fb, NULL, 0, scene_view, scene_projection, draw, NULL), "no bricks");
    expect((dfb_image_rgba8(fb) != NULL) == dfb_is_display_rank(fb), "a picture of no bricks");
}

static void check_composite(dfb_framebuffer* fb)
{
    const int bad = ranks - 1;
    char name[20];
    snprintf(name, sizeof name, "rank %d", bad);
    for (int wrong = 0; wrong < 5; ++wrong) {
        dfb_input input;
        const dfb_input* given = &input;
        const char* text = "";
        scene_bytes(rank, scene_width, scene_height, bytes, depths);
        dfb_input_init(&input);
        input.rgba8 = bytes;
        input.depth = depths;
        if (wrong == 0)
            given = rank == bad ? NULL : given, text = "a null dfb_input";
        if (wrong == 1)
            input.depth = rank == bad ? NULL : depths, text = "an image without depth";
        if (wrong == 2)
            input.struct_size += rank == bad, text = "a dfb_input of";
        if (wrong == 3)
            input.rgba32f = rank == bad ? floats : NULL, text = "an image of 8 bits and of floats";
        if (wrong == 4)
            input.region[0] = rank == bad ? INT_MIN : 0, input.region[2] = rank == bad ? INT_MAX : 0,
            text = "an image of columns -2147483648 to 2147483647";
        expect_error(dfb_composite(fb, given, 0), DFB_FRAME_FAILED, text, name, "dfb_composite");
        expect_picture(fb);
    }
    dfb_input nothing;
    dfb_input_init(&nothing);
    require(dfb_composite(fb, &nothing, 0), "nothing to show");
    expect(dfb_composite(NULL, &nothing, 0) == DFB_INVALID_ARGUMENT, "no framebuffer");
}

/* A size that cannot be changes nothing, whether the picture is of images or of bricks. */
static void check_sizes(dfb_framebuffer* fb)
{
    for (int has_bricks = 0; has_bricks < 2; ++has_bricks)
        for (int on_all_ranks = 0; on_all_ranks < 2; ++on_all_ranks) {
            if (has_bricks)
                render(fb);
            else
                composite_bytes(fb);
            if (on_all_ranks)
                require(dfb_image_on_all_ranks(fb), "dfb_image_on_all_ranks");
            const uint8_t* shown = dfb_image_rgba8(fb);
            expect((shown != NULL) == (on_all_ranks || dfb_is_display_rank(fb)), "a picture before an error");
            expect_error(dfb_resize(fb, rank == 0 ? 0 : 20, 20), DFB_INVALID_ARGUMENT, "0x20", "rank 0", "dfb_resize");
            expect(dfb_width(fb) == scene_width, "the size after an error");
            expect(dfb_image_rgba8(fb) == shown, "the picture after dfb_resize() that was refused");
        }
}

struct call {
    dfb_framebuffer* fb;
    int which, status;
};

static void* call_from_thread(void* argument)
{
    struct call* call = argument;
    dfb_input input;
    dfb_brick bricks[2];
    get_bricks(bricks);
    dfb_input_init(&input);
    if (call->which == 0)
        call->status = dfb_composite(call->fb, &input, 0);
    if (call->which == 1)
        call->status = dfb_render(call->fb, bricks, 2, scene_view, scene_projection, draw, NULL);
    if (call->which == 2)
        call->status = dfb_resize(call->fb, 20, 20);
    return NULL;
}

/* Below MPI_THREAD_SERIALIZED calls of another thread are refused, and change nothing. */
static void check_other_thread(dfb_framebuffer* fb)
{
    int level = MPI_THREAD_MULTIPLE;
    MPI_Query_thread(&level);
    for (int which = 0; which < 3 && level < MPI_THREAD_SERIALIZED; ++which)
        for (int has_bricks = 0; has_bricks < 2; ++has_bricks)
            for (int on_all_ranks = 0; on_all_ranks < 2; ++on_all_ranks) {
                /* One picture, then the other: the refused call must not bring the first one back. */
                if (has_bricks)
                    composite_bytes(fb);
                render(fb);
                if (!has_bricks)
                    composite_bytes(fb);
                if (on_all_ranks)
                    require(dfb_image_on_all_ranks(fb), "dfb_image_on_all_ranks");
                const uint8_t* shown = dfb_image_rgba8(fb);
                struct call call = {fb, which, DFB_OK};
                pthread_t thread;
                expect(pthread_create(&thread, NULL, call_from_thread, &call) == 0, "a thread");
                pthread_join(thread, NULL);
                char what[80];
                snprintf(what, sizeof what, "call %d of another thread, with bricks: %d, on all ranks: %d", which,
                         has_bricks, on_all_ranks);
                expect(call.status == DFB_INVALID_ARGUMENT, what);
                expect(dfb_image_rgba8(fb) == shown, what);
            }
}

static void check_errors(void)
{
    expect(dfb_version() && strchr(dfb_version(), '.'), "the version");
    check_creation();
    dfb_framebuffer* fb = make(DFB_NEAREST, DFB_RGBA8, 1, 1);
    expect(dfb_rank(fb) == rank && dfb_size(fb) == ranks && dfb_is_display_rank(fb) == (rank == ranks - 1),
           "the ranks");
    dfb_report report;
    expect_error(dfb_get_report(fb, &report), DFB_INVALID_ARGUMENT, "no picture yet", "", "dfb_get_report");
    expect(dfb_get_report(fb, NULL) == DFB_INVALID_ARGUMENT, "a null report");
    check_render(fb);
    check_composite(fb);
    check_sizes(fb);
    check_other_thread(fb);
    composite_bytes(fb);
    for (int has_bricks = 0; has_bricks < 2 && ranks > 1; ++has_bricks) {
        if (has_bricks)
            render(fb);
        expect_error(rank == 0 ? dfb_resize(fb, 20, 20) : dfb_image_on_all_ranks(fb), DFB_INVALID_ARGUMENT,
                     "rank 0 calls resize(), rank 1 imageOnAllRanks()", "", "ranks in different calls");
    }
    dfb_destroy(fb);

    dfb_brick bricks[2];
    get_bricks(bricks);
    fb = make(DFB_IN_ORDER, DFB_RGBA8, 0, 1);
    expect_error(dfb_render(fb, bricks, 2, scene_view, scene_projection, draw, NULL), DFB_INVALID_ARGUMENT,
                 "in an order of the ranks", "", "dfb_render");
    dfb_input input;
    dfb_input_init(&input);
    input.rgba8 = bytes;
    char text[40];
    snprintf(text, sizeof text, "place %d", ranks);
    expect_error(dfb_composite(fb, &input, rank == 0 ? ranks : rank), DFB_FRAME_FAILED, text, "rank 0",
                 "dfb_composite");
    dfb_destroy(fb);
}

static int draw_and_stop(const dfb_brick* brick, const dfb_tile* tile, void* user)
{
    int* is_to_stop = user;
    if (*is_to_stop) {
        const struct timespec pause = {0,
                                       50000000}; /* until its messages have left, as half of one blocks the others */
        nanosleep(&pause, NULL);
        raise(SIGSTOP);
    }
    *is_to_stop = 0;
    return draw(brick, tile, NULL);
}

/* Continues a process until its rank has sent a message, as it may not have stopped yet. */
static void wake(int from, pid_t process)
{
    const struct timespec pause = {0, 10000000};
    int is_there = 0, message = 0;
    while (!is_there) {
        kill(process, SIGCONT);
        nanosleep(&pause, NULL);
        MPI_Iprobe(from, 0, MPI_COMM_WORLD, &is_there, MPI_STATUS_IGNORE);
    }
    MPI_Recv(&message, 1, MPI_INT, from, 0, MPI_COMM_WORLD, MPI_STATUS_IGNORE);
}

/* The last rank is stopped, as by a batch system, and says nothing then. */
static void check_lost(void)
{
    enum { limit_ms = 1000, margin_ms = 5000 }; /* margin: for a machine that is busy with other things */
    const int lost = ranks - 1;
    int is_to_stop = rank == lost, pid = (int)getpid();
    MPI_Comm others = MPI_COMM_NULL;
    dfb_config config;
    dfb_framebuffer* fb = NULL;
    dfb_brick bricks[2];
    MPI_Bcast(&pid, 1, MPI_INT, lost, MPI_COMM_WORLD);
    MPI_Comm_split(MPI_COMM_WORLD, rank == lost, rank, &others);
    dfb_config_init(&config, scene_width, scene_height);
    config.timeout_ms = limit_ms;
    require(dfb_create(MPI_COMM_WORLD, &config, &fb), "dfb_create");
    get_bricks(bricks);
    int good = DFB_FRAME_FAILED;
    for (int tries = 0; tries < 3 && good == DFB_FRAME_FAILED; ++tries) /* the machine may pause for a second */
        good = dfb_render(fb, bricks, 2, scene_view, scene_projection, draw, NULL);
    require(good, "bricks");

    const double start = MPI_Wtime();
    const int status = dfb_render(fb, bricks, 2, scene_view, scene_projection, draw_and_stop, &is_to_stop);
    const double ms = 1e3 * (MPI_Wtime() - start);
    expect_error(status, DFB_TRANSPORT_FAILED, "not all ranks have ended this frame after 2000 ms", "", "dfb_render");
    expect(rank == lost || ms <= 2 * limit_ms + margin_ms, "told in time");
    expect(!dfb_image_rgba8(fb), "no picture");
    expect(dfb_render(fb, bricks, 2, scene_view, scene_projection, draw, NULL) == DFB_TRANSPORT_FAILED, "no other one");
    dfb_destroy(fb); /* which waits for nobody */
    MPI_Barrier(others);
    if (rank == lost)
        MPI_Send(&pid, 1, MPI_INT, 0, 0, MPI_COMM_WORLD);
    if (rank == 0)
        wake(lost, (pid_t)pid);
    MPI_Comm_free(&others);
}

int main(int argc, char** argv)
{
    int level = MPI_THREAD_SINGLE, all_failures = 0;
    dfb_framebuffer* fb = NULL;
    expect(strcmp(dfb_last_error(), "") == 0, "no error yet");
    expect(dfb_create(MPI_COMM_WORLD, NULL, &fb) == DFB_TRANSPORT_FAILED && strstr(dfb_last_error(), "MPI_Init"),
           "dfb_create() before MPI_Init()");
    expect(dfb_create_fortran(0, NULL, &fb) == DFB_TRANSPORT_FAILED, "dfb_create_fortran() before MPI_Init()");
    if (argc > 1 && strcmp(argv[argc - 1], "multiple") == 0)
        MPI_Init_thread(&argc, &argv, MPI_THREAD_MULTIPLE, &level);
    else
        MPI_Init(&argc, &argv);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    MPI_Comm_size(MPI_COMM_WORLD, &ranks);
    if (argc > 2 && strcmp(argv[1], "write") == 0)
        write_all(argv[2]);
    else if (argc > 1 && strcmp(argv[1], "lost") == 0)
        check_lost();
    else
        check_errors();
    MPI_Allreduce(&failures, &all_failures, 1, MPI_INT, MPI_SUM, MPI_COMM_WORLD);
    if (level == MPI_THREAD_SINGLE) { /* so no thread of the library calls MPI */
        dfb_config config;
        dfb_config_init(&config, 10, 10);
        require(dfb_create(MPI_COMM_SELF, &config, &fb), "dfb_create");
    }
    MPI_Finalize();
    if (fb) {
        dfb_input input;
        dfb_input_init(&input);
        if (dfb_composite(fb, &input, 0) != DFB_TRANSPORT_FAILED || !strstr(dfb_last_error(), "MPI has been finalised"))
            fprintf(stderr, "dfb_composite() after MPI_Finalize(): %s\n", dfb_last_error()), all_failures = 1;
        dfb_destroy(fb);
    }
    return all_failures > 0;
}
