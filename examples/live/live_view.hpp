// LiveView: shows the pictures of a running job in browsers, and tells the job what their users want to see.
//
// One rank makes it, the one that has the image. It listens on 127.0.0.1 alone, and answers nobody who does not know
// the random token in url(). Viewers fetch pictures when they are ready for one, so that a slow viewer gets fewer; all
// that a viewer can do to the job is to change its wishes.
#pragma once

#include <dfb/frame.hpp>

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
    double distance = 0;               // in units of LiveScene::unit; 0: so that all is in the image
    std::array<double, 3> target{};    // in the world
};

// The wishes of the viewers. Its bytes may be sent to other ranks as they are.
struct LiveWishes {
    std::uint64_t number = 0; // grows with each change
    std::uint64_t look = 0;   // the number of the last change of camera or size
    LiveCamera camera;
    std::int32_t width = 0, height = 0; // pixels, 16 to LiveScene::mostSide
    std::int32_t samples = 1;           // per pixel while the camera rests
    std::int32_t isPaused = 0;
    std::int64_t steps = 0; // how often a single step was asked for
    std::int32_t ends = 0;  // the job is to end: somebody has pressed the button, or Interrupt::happened()
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

// A picture's data beside its pixels, for show().
struct LivePicture {
    LiveWishes wishes;       // that it shows
    double distance = 0;     // of its camera
    int samples = 1;         // per pixel
    std::string camera;      // as words of a command line; may be empty
    std::int64_t step = -1;  // of a simulation
    int tileSize = 0;        // of the framebuffer
    std::vector<int> owners; // rank of each tile, row by row
};

class LiveView {
public:
    static constexpr int defaultPort = 8080;

    // Begins to listen. `port` 0: any port that is free; -1: the default port, or any if that is taken. `title` is
    // shown on the page; `hasSteps`: there is a simulation that can be paused. Throws std::runtime_error if the port
    // cannot be had, or if this program was built without what a live view needs.
    static std::unique_ptr<LiveView> listen(const std::string& title, int port, bool hasSteps);

    LiveView() = default;
    LiveView(const LiveView&) = delete;
    LiveView& operator=(const LiveView&) = delete;
    // Tells the viewers that the job has ended. Waits until their requests are answered, two seconds at most.
    virtual ~LiveView() = default;

    // For a browser on this machine.
    virtual const std::string& url() const = 0;

    // Viewers may have wishes from now on; `home` is what is shown until they have.
    virtual void open(const LiveScene& scene, const LiveWishes& home) = 0;

    // Returns their wishes of this moment. Any thread.
    virtual LiveWishes wishes() const = 0;
    // Waits until they want something else than at `number`, or the job is to end, or for `atMost`.
    virtual LiveWishes waitForChange(std::uint64_t number, std::chrono::milliseconds atMost) const = 0;

    // Whether camera or size have changed since `look`, or the job is to end. With `onlyIfSmaller`: whether the size
    // has become smaller since, as it does when somebody begins to turn a picture that takes long. Cheap. Any thread.
    virtual bool hasMoved(std::uint64_t look, bool onlyIfSmaller) const = 0;
    // Runs `work`. If hasMoved() becomes true meanwhile, or is, `onMove` is called once, by any thread, unless it is
    // for a signal, for which work() must look itself.
    virtual void whileWatching(std::uint64_t look, bool onlyIfSmaller, const std::function<void()>& onMove,
                               const std::function<void()>& work) = 0;

    // Shows 8-bit RGBA pixels, whose alpha is left out, and what the report says of them. Copies both; waits for no
    // viewer. By one thread.
    virtual void show(const std::uint8_t* rgba, int width, int height, const dfb::FrameReport& report,
                      LivePicture picture) = 0;
};

// The tiles of a framebuffer, for the picture.
template <class FrameBuffer>
void tellTiles(const FrameBuffer& fb, LivePicture& picture)
{
    picture.tileSize = fb.layout().tileSize();
    for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
        picture.owners.push_back(fb.tileOwner(tile));
}

// Returns the wishes of the display rank's viewers, on all ranks, with `ends` if any rank is to end. `mine`: on the
// display rank LiveView::wishes(), or what waitForChange() has returned; on the others only `ends` counts. Collective,
// outside frames.
template <class FrameBuffer>
LiveWishes shareWishes(FrameBuffer& fb, const LiveWishes& mine)
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
