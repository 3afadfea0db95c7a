// RunFrames: the frames of a run: a framebuffer with whatever operations the options ask for, and the loop over it. The
// rest of a run does not depend on the operations, so it is compiled only once.
#pragma once

#include "options.hpp"
#include "rank_scene.hpp"

#include <dfb/dfb.hpp>
#include <dfb/testing/verified.hpp>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <vector>

namespace example {

// What a rank renders. It is loaded with the help of the framebuffer, so the framebuffer is made first.
struct RankWork {
    std::unique_ptr<RankScene> scene;
    RenderSettings settings;
    dfb::World world;
    std::optional<dfb::SharedWorld> shared;          // except with Mode::Image
    std::function<void(std::int64_t work)> tileDone; // from any thread
};

class RunFrames {
public:
    virtual ~RunFrames() = default;

    virtual dfb::FrameBufferBase& framebuffer() = 0;

    // Null if there is none.
    virtual const dfb::DisplayWall* wall() const = 0;

    // Begins frame number `frame` of the run, and renders what this rank has to.
    virtual void start(int frame, const RankWork& work, const dfb::FrameConfig& params) = 0;
    // How many frames have begun and not ended.
    virtual int openCount() const = 0;
    // The oldest open frame.
    virtual dfb::FrameBase& oldest() = 0;
    // Ends it. If Frame::end() throws, the frame stays for leaveAll().
    virtual dfb::FrameReport end() = 0;
    // Destroys all open frames without end().
    virtual void leaveAll() = 0;
};

// Collective. `options` and `verification` must outlive the frames. A compositing that checks itself reports to
// `verification`. Throws as the constructor of DistributedFrameBuffer does.
std::unique_ptr<RunFrames> makeFrames(std::shared_ptr<dfb::Connection> connection, const Options& options,
                                      const dfb::FrameBufferConfig& config, dfb::testing::Verification& verification);

} // namespace example
