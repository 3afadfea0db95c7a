// LiveView: shows the pictures of a running job in browsers, and tells the job what their users want to see.
//
// The rank that has the image makes it. It listens only on 127.0.0.1, and refuses requests without the random token in
// url(). Viewers fetch a picture when they are ready for it, so a slow viewer gets fewer. All that a viewer can do to
// the job is to change the wishes.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/framebuffer_base.hpp>

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <memory>
#include <string>
#include <type_traits>
#include <vector>

namespace example {

// Looks at `target`, from `distance` away: azimuth and elevation are as in LiveScene::axes.
struct LiveCamera {
    double azimuth = 0, elevation = 0; // degrees
    double distance = 0;               // in units of LiveScene::unit; 0: far enough to see everything
    std::array<double, 3> target{};    // in the world
};

// What the viewers want to see (their wishes), in common for all of them. It can be sent to other ranks as bytes.
struct LiveWishes {
    std::uint64_t number = 0; // grows with each change
    std::uint64_t look = 0;   // the number of the last change of camera or size
    LiveCamera camera;
    std::int32_t width = 0, height = 0; // pixels, 16 to LiveScene::mostSide
    std::int32_t samples = 1;           // per pixel while the camera rests
    std::int32_t isPaused = 0;
    std::int64_t steps = 0; // how often a single step was asked for
    std::int32_t ends = 0;  // the job is to end: a viewer has pressed the button, or Interrupt::happened()
};
static_assert(std::is_trivially_copyable_v<LiveWishes>);

// The scene as a page needs it to turn a camera. The camera is at target + distance * unit * outward, with
// outward = cos(elevation) * sin(azimuth) * axes[0] + sin(elevation) * axes[1] + cos(elevation) * cos(azimuth) *
// axes[2].
struct LiveScene {
    std::array<std::array<double, 3>, 3> axes{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
    double unit = 1;         // of distances, in the world
    double fieldOfView = 35; // vertical, in degrees
    int mostSamples = 1;
    int mostSide = 4096;
    int ranks = 1;
};

// What show() gets of a picture besides its pixels.
struct LivePicture {
    LiveWishes wishes;       // the picture was made for these
    double distance = 0;     // of its camera
    int samples = 1;         // per pixel
    std::string camera;      // as options of a command line; may be empty
    std::int64_t step = -1;  // of a simulation
    int tileSize = 0;        // of the framebuffer
    std::vector<int> owners; // rank of each tile, row by row
};

class LiveView {
public:
    static constexpr int defaultPort = 8080;

    // Begins to listen. `port` 0: any port that is free; -1: the default port, or any if that is taken. `title` is
    // shown on the page; `hasSteps`: there is a simulation that can be paused. Throws std::runtime_error if the port is
    // not available, or if this program was built without what a live view needs.
    static std::unique_ptr<LiveView> listen(const std::string& title, int port, bool hasSteps);

    LiveView() = default;
    LiveView(const LiveView&) = delete;
    LiveView& operator=(const LiveView&) = delete;
    // Tells the viewers that the job has ended. Waits until their requests are answered, two seconds at most.
    virtual ~LiveView() = default;

    // The address to open in a browser on this machine.
    virtual const std::string& url() const = 0;
    // Two lines to print: the address, and the command that makes it reachable from another machine.
    virtual std::string invitation() const = 0;

    // Viewers may have wishes from now on; `home` is what is shown until they have.
    virtual void open(const LiveScene& scene, const LiveWishes& home) = 0;

    // Waits until the wishes are others than those of this `number`, the job is to end, or `atMost` has passed. Returns
    // the wishes.
    virtual LiveWishes waitForChange(std::uint64_t number, std::chrono::milliseconds atMost) const = 0;

    // Whether camera or size have changed since `look`, or the job is to end. With `onlyIfSmaller`: whether the size
    // has become smaller since, as it does when a viewer begins to turn a picture that takes long. Cheap. Any thread.
    virtual bool hasMoved(std::uint64_t look, bool onlyIfSmaller) const = 0;
    // Runs `work`. If hasMoved() is true or becomes true meanwhile, `onMove` is called once, by any thread. A signal
    // during `work` does not cause that call: `work` must test for it itself.
    virtual void whileWatching(std::uint64_t look, bool onlyIfSmaller, const std::function<void()>& onMove,
                               const std::function<void()>& work) = 0;

    // Shows 8-bit RGBA pixels without their alpha, and what the report says about their frame. Copies both; waits for
    // no viewer. Always the same thread.
    virtual void show(const std::uint8_t* rgba, int width, int height, const dfb::FrameReport& report,
                      LivePicture picture) = 0;
};

// Stores the size and the owners of a framebuffer's tiles in a picture.
inline void tellTiles(const dfb::FrameBufferBase& fb, LivePicture& picture)
{
    picture.tileSize = fb.layout().tileSize();
    for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
        picture.owners.push_back(fb.tileOwner(tile));
}

// Returns the wishes of the display rank's viewers, on all ranks, with `ends` set if it is set on any rank. `mine` is,
// on the display rank, what LiveView::waitForChange() has returned; on the others only its `ends` counts.
// Collective, outside frames.
inline LiveWishes shareWishes(dfb::FrameBufferBase& fb, const LiveWishes& mine)
{
    const auto* first = reinterpret_cast<const std::byte*>(&mine);
    const auto ofRanks = fb.allGather({first, first + sizeof mine});
    LiveWishes shared, one;
    bool ends = false;
    for (std::size_t rank = 0; rank < ofRanks.size(); ++rank) {
        std::memcpy(&one, ofRanks[rank].data(), sizeof one);
        ends = ends || one.ends != 0;
        if (rank == static_cast<std::size_t>(fb.config().image.displayRank))
            shared = one;
    }
    shared.ends = ends;
    return shared;
}

} // namespace example
