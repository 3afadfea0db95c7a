// dfb from C99: images or bricks of data of many MPI ranks become one picture. README.md says how to build with it.
//
//   dfb_config config;
//   dfb_config_init(&config, 1024, 768);
//   dfb_framebuffer* fb = NULL;
//   if (dfb_create(MPI_COMM_WORLD, &config, &fb) != DFB_OK) fail(dfb_last_error());
//   dfb_render(fb, bricks, count, view, projection, render_brick, NULL);
//   if (dfb_is_display_rank(fb)) show(dfb_image_rgba8(fb));
//   dfb_destroy(fb);
//
// Functions that return int return a dfb_status unless they say otherwise. "Collective" means that all ranks of the
// communicator must call it, in the same order. What is wrong on one rank in a collective call, such as a null pointer
// or a failing renderer, is an error on all ranks, with the rank and the reason in dfb_last_error(). Nobody hangs, and
// the next picture can be made. Only the communicator and the framebuffer must be right on every rank: without them a
// rank cannot tell the others. If a rank makes another call, or none, the others wait for it; timeout_ms limits how
// long they wait for a picture. One thread at a time may call functions on a framebuffer. With MPI below
// MPI_THREAD_SERIALIZED it must be the one that has initialised MPI. No exception leaves a function.
#ifndef DFB_H
#define DFB_H

#include <mpi.h>

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

// One per rank: the picture, and the connection to the other ranks.
typedef struct dfb_framebuffer dfb_framebuffer;

enum dfb_status {
    DFB_OK = 0,
    DFB_INVALID_ARGUMENT = 1, // a wrong argument, or a call that is not allowed now; nothing has changed
    DFB_FRAME_FAILED = 2,     // the picture could not be made, on all ranks; the next can be
    DFB_TRANSPORT_FAILED = 3, // MPI cannot be used, or a rank is lost: the framebuffer is of no further use
    DFB_OUT_OF_MEMORY = 4,    // on this rank
    DFB_FAILED = 5            // anything else, such as that the system gives no more threads
};

// How the inputs of a pixel become one.
enum dfb_blend {
    DFB_NEAREST = 0,  // the one with the least depth, for opaque geometry; a pixel without a depth is empty
    DFB_BY_DEPTH = 1, // all of them blended front to back by depth
    DFB_IN_ORDER = 2  // images blended front to back in an order of the ranks, without depth; dfb_composite() only
};

// Pixels of the picture: premultiplied RGBA, row by row from the top.
enum dfb_format {
    DFB_RGBA8 = 0,  // 8 bits a channel, linear; also for images that are encoded for a display already
    DFB_SRGBA8 = 1, // 8 bits a channel, colour through the sRGB curve, alpha linear
    DFB_RGBA32F = 2 // floats, linear
};

// All ranks must give the same values, except for `threads`. dfb_config_init() sets the defaults, the values after the
// semicolons.
typedef struct dfb_config {
    size_t struct_size; // of the dfb.h that the program was compiled with
    int width, height;  // of the picture in pixels, 1 to 65536
    int blend;          // a dfb_blend; DFB_BY_DEPTH
    int format;         // a dfb_format; DFB_SRGBA8
    int depth;          // 1: the picture has a depth for each pixel; 0
    int display_rank;   // the rank that gets the picture; 0
    // Threads of this rank that render and composite. 1: only the calling thread, so a renderer need not be
    // thread-safe. 0: one for each core that this rank has for itself. Default: 1.
    int threads;
    float background[4]; // premultiplied linear RGBA behind everything; 0, 0, 0, 0
    // The longest time for a picture in milliseconds, counted from when this rank has drawn or given its part. If the
    // picture is not complete by then, the call returns DFB_FRAME_FAILED; if a rank does not answer at all, as when it
    // is dead, DFB_TRANSPORT_FAILED after twice the time. The error says which rank it waited for. Default: 0, no
    // limit. Other calls have no limit, nor has the first dfb_render() after dfb_create() or dfb_resize(): it makes
    // what later ones use.
    int timeout_ms;
} dfb_config;

// Sets `config` to the defaults above, for a picture of this size.
#define dfb_config_init(config, width, height) dfb_config_init_sized(config, sizeof(dfb_config), width, height)
void dfb_config_init_sized(dfb_config* config, size_t struct_size, int width, int height);

// Makes a framebuffer on a duplicate of the communicator, with the calling thread, and stores it in *framebuffer; NULL
// if there was an error. MPI must have been initialised, at any thread level. Collective; waits for all ranks.
// DFB_INVALID_ARGUMENT on all ranks if the configuration is wrong on any rank or differs between ranks, or if a rank
// lacks memory. Backgrounds or time-outs that differ fail each picture.
int dfb_create(MPI_Comm communicator, const dfb_config* config, dfb_framebuffer** framebuffer);
// For a Fortran handle: the one of `use mpi`, or the mpi_val of a communicator of `use mpi_f08`. Otherwise as above.
int dfb_create_fortran(MPI_Fint communicator, const dfb_config* config, dfb_framebuffer** framebuffer);

// Destroys a framebuffer; call it before MPI_Finalize(). Pointers to its picture become invalid. Null is ignored, and
// so is a call from a renderer of this framebuffer. Collective; waits for all ranks.
void dfb_destroy(dfb_framebuffer* framebuffer);

// Changes the size of the picture, which is empty then. Collective; waits for all ranks. DFB_INVALID_ARGUMENT on all
// ranks, with nothing changed, if the size is out of range or differs between ranks, or if a rank lacks memory.
int dfb_resize(dfb_framebuffer* framebuffer, int width, int height);

// The place of this rank in the communicator, and the number of ranks; -1 without a framebuffer.
int dfb_rank(const dfb_framebuffer* framebuffer);
int dfb_size(const dfb_framebuffer* framebuffer);
// Whether this rank gets the picture: 1 or 0.
int dfb_is_display_rank(const dfb_framebuffer* framebuffer);
// The size of the picture in pixels; 0 without a framebuffer.
int dfb_width(const dfb_framebuffer* framebuffer);
int dfb_height(const dfb_framebuffer* framebuffer);

// ---- images that the ranks have rendered already

// An image in memory of the program. dfb_input_init() sets it to an input with nothing to show.
typedef struct dfb_input {
    size_t struct_size; // of the dfb.h that the program was compiled with
    // Set one of the two: 4 bytes or floats a pixel. 8-bit colours are blended as they are: level k counts as the float
    // nearest to k / 255. If they are sRGB colours, ask for the format DFB_RGBA8, which does not encode them a second
    // time.
    const uint8_t* rgba8;
    const float* rgba32f;
    const float* depth;     // one a pixel, grows away from the camera; with DFB_IN_ORDER only for a picture with depth
    ptrdiff_t row_pixels;   // from a row to the next, of colour and depth; 0: the width of `region`
    int bottom_up;          // 1: the first row is the lowest, as in OpenGL
    int is_bgra;            // 1: the channels are blue, green, red, alpha
    int has_straight_alpha; // 1: colours are not multiplied by alpha yet
    float far_depth;        // a pixel at this depth or beyond is empty; +infinity, in OpenGL 1
    // x0, y0, x1, y1: the part of the picture that the memory holds, [x0, x1) x [y0, y1). x counts from the left, y
    // from the first row. All zeros: the whole picture. Any other of width or height 0: nothing to show.
    int region[4];
    // Pixels outside of this part of the picture are empty and are not read. Coordinates as in `region`. Default: all
    // of the picture.
    int valid[4];
} dfb_input;

#define dfb_input_init(input) dfb_input_init_sized(input, sizeof(dfb_input))
void dfb_input_init_sized(dfb_input* input, size_t struct_size);

// Makes one picture of the images of all ranks. With DFB_IN_ORDER, `place` is this rank's place in the order: 0 is in
// front, and each rank has a different one. Otherwise, and on a rank with nothing to show, `place` is ignored. A null
// `input` means that this rank could not make its image. The memory of the image is only read during the call.
// Collective; waits until the picture is complete on the display rank. DFB_FRAME_FAILED on all ranks if the image of
// one is wrong or null.
int dfb_composite(dfb_framebuffer* framebuffer, const dfb_input* input, int place);

// ---- bricks of data that the ranks render

// A convex part of the data, which overlaps no other part, and its axis-aligned box, in the program's unit of length.
typedef struct dfb_brick {
    uint32_t id; // a different one for each brick of all ranks
    float lower[3], upper[3];
} dfb_brick;

// The pixels that a renderer fills: [x0, x1) x [y0, y1) of a picture of width x height, row 0 on top. Pixel (x, y) is
// number i = (y - y0) * row_pixels + (x - x0): rgba[4 * i], depth[i].
typedef struct dfb_tile {
    int x0, y0, x1, y1;
    int width, height;
    ptrdiff_t row_pixels; // from a row to the next
    float* rgba;          // premultiplied linear RGBA; all 0 before the renderer is called
    float* depth;         // grows away from the camera; all +infinity before
} dfb_tile;

// Fills those pixels of the tile whose rays meet the brick, as far as they are within its box. `brick` is the element
// of the array that dfb_render() got. Returns 0, or another number if it failed: the picture fails on all ranks then,
// with the brick and the number in the error. The thread that is in dfb_render() calls it; if dfb_config::threads is
// not 1, several other threads call it at once. It must not call functions on the framebuffer, nor functions of MPI that wait for
// other ranks.
typedef int (*dfb_render_brick)(const dfb_brick* brick, const dfb_tile* tile, void* user);

// Makes one picture of the bricks of all ranks. Calls render_brick(brick, tile, user) for each of this rank's `count`
// bricks and each tile that it may cover; there may be none. The camera is a view matrix and a projection matrix,
// perspective, off-axis or orthographic, column by column as OpenGL takes them; the numbers are rounded to floats. The
// far plane cuts nothing off. Bricks and matrices are read only during the call; the program may change them
// afterwards. All ranks must give the same camera. Collective; waits until the picture is complete on the display rank.
// DFB_FRAME_FAILED on all ranks if a renderer fails, or if bricks, matrices or pointers are wrong on one rank.
// DFB_INVALID_ARGUMENT with DFB_IN_ORDER.
int dfb_render(dfb_framebuffer* framebuffer, const dfb_brick* bricks, int count, const double view[16],
               const double projection[16], dfb_render_brick render_brick, void* user);

// ---- the picture

// The last picture, on the display rank, until the next dfb_composite(), dfb_render(), dfb_resize() or dfb_destroy():
// width x height pixels, row by row from the top. Null on other ranks, if the format is another one, before the first
// picture, and after one that failed. A depth is +infinity where nothing was hit.
const uint8_t* dfb_image_rgba8(const dfb_framebuffer* framebuffer); // also for DFB_SRGBA8
const float* dfb_image_rgba32f(const dfb_framebuffer* framebuffer);
const float* dfb_image_depth(const dfb_framebuffer* framebuffer);

// Copies the picture to all ranks. These functions then return it on each. Collective; waits for all ranks.
int dfb_image_on_all_ranks(dfb_framebuffer* framebuffer);

// The cost of the last picture that was made. Times are in milliseconds. They are of this rank, except for
// render_ms_max. The other numbers are sums over all ranks.
typedef struct dfb_report {
    int64_t frame;                  // its number
    double total_ms;                // from its begin to its end
    double render_ms;               // of this, until all bricks were rendered, or the image was read
    double compositing_overhead_ms; // and from then on
    double render_ms_max;           // the longest render_ms of all ranks
    int64_t bytes_sent;
    int64_t messages_sent;
    int64_t tiles_total;            // in the picture
    int64_t tiles_touched;          // of them, those that had an input
    int64_t non_finite_pixels;      // of inputs, with an infinity or NaN
    int64_t alpha_outside_pixels;   // of inputs, whose alpha is not within [0, 1]
    int64_t order_undefined_pixels; // of the picture, where depths gave the inputs no order
    int64_t peak_memory_bytes;      // of messages and images, of the rank that has the most
    int threads;                    // that this rank worked with
} dfb_report;

// Stores the report in *report. DFB_INVALID_ARGUMENT before the first picture. Not collective; waits for nothing.
#define dfb_get_report(framebuffer, report) dfb_get_report_sized(framebuffer, report, sizeof(dfb_report))
int dfb_get_report_sized(const dfb_framebuffer* framebuffer, dfb_report* report, size_t struct_size);

// The text of the last error that a function of this file returned on this thread; "" if there was none. Valid until
// the next error.
const char* dfb_last_error(void);

// The version of the library: "MAJOR.MINOR.PATCH".
const char* dfb_version(void);

#ifdef __cplusplus
}
#endif

#endif
