// Engine: the interface of a framebuffer's implementation, for one frame at a time and operations of any type. The
// implementation is in frame/frame_engine.hpp; a program that links dfb::compiled does not compile it.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/comm/connection.hpp>
#include <dfb/compiled.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/operations.hpp>
#include <dfb/image.hpp>
#include <dfb/tile.hpp>
#include <dfb/tile_layout.hpp>

#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// A rank's word to another rank about one of its inputs and the inputs behind that one. See FrameBase::hide().
struct HidingWord {
    enum Effect : std::int32_t {
        Hides,
        MayHide, // it hid them in the last frame; Hides or Shows follows
        Shows
    };
    std::int32_t tile = 0;
    std::int32_t generation = 0; // the first generation behind the input
    Effect effect = Hides;
};

// The members are those of DistributedFrameBuffer and its Frame; see there.
class Engine {
public:
    virtual ~Engine() = default;

    virtual int rank() const noexcept = 0;
    virtual int size() const noexcept = 0;
    virtual const FrameBufferConfig& config() const noexcept = 0;
    virtual const TileLayout& layout() const noexcept = 0;
    virtual int tileOwner(int tile) const noexcept = 0;
    virtual const std::vector<int>& ownedTiles() const noexcept = 0;
    virtual int ownerNow(int tile) const noexcept = 0; // in the frame that is open
    virtual const std::vector<int>& ownedNow() const noexcept = 0;
    virtual const std::vector<int>& nodeOf() const noexcept = 0; // for each rank, the lowest rank on its node
    virtual const Image& image() const noexcept = 0;
    virtual std::int64_t imageFrame() const noexcept = 0;
    virtual Image imageOnAllRanks(Engine& gatherer) = 0; // by an allGather() of that engine
    virtual bool isComplete(int tile) const = 0;
    virtual bool poll() = 0;
    // By the executor. If nobody else moves messages, the calling thread does, while workers run the loop.
    virtual void parallelFor(std::size_t count, FunctionRef<void(std::size_t)> body) = 0;
    virtual std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Reduce how) = 0;
    virtual std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& own, const char* call) = 0;

    virtual bool isOpen() const noexcept = 0;
    virtual void begin(const FrameConfig& params, FunctionRef<void()> copyData) = 0; // copies the operations' data
    virtual std::int64_t frame() const noexcept = 0; // the number of the frame that was begun last
    virtual TileHeader headerOf(int tile, int pass) const = 0;
    virtual ChannelMask sent() const noexcept = 0; // the channels of inputs that travel in this frame
    virtual void setTile(const InputPixels& tile) = 0;
    virtual bool isHidden(int tile, int generation) const = 0;
    virtual bool opaqueHides(int tile) const = 0;
    virtual bool isUndecided(int tile, int generation) const = 0;
    virtual void tell(int other, const HidingWord& word) = 0;
    virtual bool waitForWord(FunctionRef<bool()> heard) = 0;
    virtual void declare(const std::vector<TileInput>& inputs) = 0;
    virtual void expectLayers(int layers) = 0;
    virtual TileSamples samples(int tile) const = 0;
    virtual std::int64_t nextJob(std::int64_t count) = 0;
    virtual void addFigure(std::uint64_t key, double value) = 0;
    virtual void noteMergeError(int tile, double bound) = 0;
    virtual bool failed() const noexcept = 0;
    virtual void abort(std::int64_t frame, const std::exception_ptr& reason, int tile) = 0;
    virtual void requireProgress() const = 0;
    virtual void tryVote() = 0; // again, when messages have moved
    // Gives this engine all engines of its framebuffer: when one has moved messages, all try to vote. Until then it
    // knows only itself.
    virtual void setTogether(std::vector<Engine*> engines) = 0;
    virtual void closeInputs() = 0; // this rank sets no more tiles: it may vote before end(). Again: nothing
    virtual bool isDone() = 0;
    virtual FrameReport end() = 0;
    virtual void leave() noexcept = 0; // in place of end(), when an exception passes
};

// The deleter of a unique_ptr to an engine whose frame is open.
struct LeaveFrame {
    void operator()(Engine* engine) const noexcept { engine->leave(); }
};

// Collective. `operations` must live as long as the engine; `slot`: which of config.framesInFlight engines this is.
// Throws as the constructor of DistributedFrameBuffer does.
DFB_COMPILED_ONCE std::unique_ptr<Engine> makeEngine(std::shared_ptr<Connection> connection, FrameBufferConfig config,
                                                     Operations& operations, int slot);

} // namespace detail
DFB_NAMESPACE_END
