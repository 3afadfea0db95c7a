// DistributedFrameBuffer: makes one image from the tiles that many ranks render. Each tile is composited independently:
// setTile() sends an input to the owner of the tile. When all inputs of a tile have come, the tile operation makes the
// finished tile, the pixel operation post-processes it, and it goes to the display rank. "The paper" in these comments
// is Usher et al., "Scalable Ray Tracing Using the Distributed FrameBuffer", 2019; this is its section 3.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/framebuffer_base.hpp>
#include <dfb/fwd.hpp>
#include <dfb/pixel_op.hpp>
#include <dfb/tile.hpp>

#include <cstdint>
#include <exception>
#include <memory>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// A frame that has begun: see FrameBase. `Channels` and `Size` are those of its tiles.
template <ChannelMask Channels, int Size>
class [[nodiscard]] BasicFrame : public FrameBase {
public:
    using Tile = dfb::Tile<Channels, Size>;
    using TileView = dfb::TileView<Channels, Size>;

    // Prepares `tile` for a tile and a pass of this frame: clears it, and sets generation 0, no children, this rank as
    // source, and part 0. Other channels than colour and depth are cleared only if they are sent in this frame. Throws
    // InvalidArgument if there is no such tile or pass.
    void start(Tile& tile, int tileIndex, int pass = 0) const
    {
        static_cast<TileHeader&>(tile) = engine()->headerOf(tileIndex, pass);
        tile.clear(engine()->sent() | depthChannel); // a renderer may compare with the depth that is there
    }
    // Prepares a view. Its planes are null afterwards: point them to your pixels. Throws as above.
    void start(TileView& tile, int tileIndex, int pass = 0) const
    {
        const TileHeader header = engine()->headerOf(tileIndex, pass);
        tile = TileView();
        static_cast<TileHeader&>(tile) = header;
    }

    // Sends the active pixels of a rendered tile to its owner. `tile` can be used again when setTile() returns. After
    // end(), and in a frame that has failed, it checks the tile but sends nothing. Waits only while more than
    // messages.poolBytes are under way from this rank, and runs tasks of the executor meanwhile. A thread that may not
    // call MPI does not wait. Throws InvalidArgument, with nothing sent, for a tile of another frame, an index, region
    // or pass that the frame does not have, a generation that is not 0 to 65535, or a negative number of children.
    // Throws OutOfMemory, and what the codec throws. An input that contradicts others (too many, sent twice, not
    // announced) makes the frame fail: end() throws.
    void setTile(const Tile& tile) { engine()->setTile(tile); }
    // Sends pixels that lie in your own memory. They are not read after setTile() has returned, unless you promise
    // TileView::staysUntilEnd. Waits and throws as above. Also throws InvalidArgument if a channel that must be
    // sent is null, or if rows overlap.
    void setTile(const TileView& tile) { engine()->setTile(tile); }

    // Whether `tile`, which setTile() has sent, hides the inputs of higher generations. If it does, call hide() for
    // the ranks that have such inputs.
    bool hidesRest(const Tile& tile) const { return opaqueHides(tile.tile) && tile.isOpaque(); }
    bool hidesRest(const TileView& tile) const { return opaqueHides(tile.tile) && tile.isOpaque(); }

    // Calls job(i, tile) for each i in [0, count), by Executor::parallelFor(): on several threads at once. Each thread
    // has a tile of its own: a Tile, or a TileView if that is the template argument. The job calls start(tile, ...),
    // renders, and calls setTile(tile). Any thread may call forEachTile(). Not collective. Waits until all jobs have
    // returned, and for other ranks only inside setTile(). Throws nothing. An exception of a job makes the frame fail
    // as in guard(), and no other job begins. With FrameConfig::allowPartial the frame goes on without that job's tile.
    template <class WorkerTile = Tile, class Job>
    void forEachTile(std::int64_t count, const Job& job)
    {
        using Spare = SpareTile<WorkerTile>;
        forEachJob(count, Spare::take, Spare::keep,
                   [&](std::int64_t i, TileHeader& tile) { job(i, static_cast<WorkerTile&>(tile)); });
    }

    // Calls render(tile) for each pass of each of these tiles, after start(). render(tile) calls setTile(tile).
    // Threads, waiting and exceptions as above.
    template <class WorkerTile = Tile, class Render>
    void forEachTile(const std::vector<int>& tiles, const Render& render)
    {
        forEachTile<WorkerTile>(static_cast<std::int64_t>(tiles.size()), [&](std::int64_t i, WorkerTile& tile) {
            const int index = tiles[static_cast<std::size_t>(i)];
            for (int pass = 0; pass < samples(index).count && !failed(); ++pass) {
                start(tile, index, pass);
                render(tile);
            }
        });
    }

private:
    template <class TileOp, class PixelOp, class Transport>
    friend class DistributedFrameBuffer;
    using FrameBase::FrameBase;
};

// One object per rank. Construction and destruction are collective over the communicator. One thread at a time may call
// the constructor, begin(), end(), isDone() and the collective members. On a thread that may not call MPI (see
// Progress in comm/transport.hpp) these throw InvalidArgument, on this rank alone; a constructor that gets a
// communicator throws TransportError. Members that do not depend on the operations are in FrameBufferBase.
template <class TileOp, class PixelOp, class Transport>
class DistributedFrameBuffer : public FrameBufferBase {
    static_assert(detail::checkTileOp<TileOp>());
    static_assert(detail::checkPixelOp<PixelOp>());
    static_assert(detail::checkTransport<Transport>());

    using Operations = detail::OperationsOf<TileOp, PixelOp>;

public:
    using Communicator = typename Transport::Communicator;
    using Frame = BasicFrame<TileOp::channels, detail::tile_size_v<TileOp>>;
    using Tile = typename Frame::Tile;
    using TileView = typename Frame::TileView;
    static constexpr bool takesOrder = detail::takes_order_v<TileOp>; // whether FrameConfig::order has an effect
    static constexpr bool keepsState = detail::keeps_state_v<TileOp>; // FrameConfig::owners cannot be set then
    using TileFrameData = typename Operations::TileFrameData;
    using PixelFrameData = typename Operations::PixelFrameData;

    // Makes a connection over the communicator and a framebuffer on it. Collective. Waits for all ranks. Throws
    // InvalidArgument on every rank if the configuration is wrong on any rank or differs between ranks, or if a rank
    // lacks memory; TransportError if the transport cannot be used; std::system_error on a rank that gets no threads,
    // and TransportError on the others.
    DistributedFrameBuffer(const Communicator& communicator, Config config, PixelOp pixelOp = {})
        : DistributedFrameBuffer(connect<Transport>(communicator, NetworkConfig()), std::move(config),
                                 std::move(pixelOp))
    {
    }

    // As above, with a network configuration of your own.
    DistributedFrameBuffer(const Communicator& communicator, Config config, NetworkConfig network, PixelOp pixelOp = {})
        : DistributedFrameBuffer(connect<Transport>(communicator, std::move(network)), std::move(config),
                                 std::move(pixelOp))
    {
    }

    // Makes a framebuffer on a connection. Several framebuffers may share a connection; all ranks must make them in the
    // same order. Collective. Waits and throws as above.
    DistributedFrameBuffer(std::shared_ptr<Connection> connection, Config config, PixelOp pixelOp = {})
        : FrameBufferBase(std::move(connection), std::move(config),
                          [&] { return std::unique_ptr<detail::Operations>(new Operations(pixelOp)); })
    {
    }

    // Collective. If a frame is open, it ends the process by std::abort(). Must come before MPI_Finalize(). Whoever
    // releases the connection last waits for all ranks: this, another object on it, or your own shared_ptr.
    ~DistributedFrameBuffer() = default;

    // Begins a frame. Every rank must call it, with an equal `params`. If several frames are open, all ranks must call
    // begin() and end() in the same order: a rank takes inputs of a frame only after its own begin() of it, and
    // setTile() on other ranks may wait for that. Copies `tileData`, and passes `pixelData` to newFrame() of the pixel
    // operation. `failure`: an exception that was thrown while `params` were made, if any. If it is given, or if the
    // copy or newFrame() throws, end() throws a FrameError with the text on all ranks, as after Frame::abort(). Waits
    // for no other rank. Throws InvalidArgument, with nothing sent, if the frame that was begun config.framesInFlight
    // frames ago is still open, if a field of `params` is out of range, or on a thread that may not call MPI (see
    // Progress). Throws TransportError if the connection has failed.
    Frame begin(const FrameConfig& params = {}, const TileFrameData& tileData = {},
                const PixelFrameData& pixelData = {}, const std::exception_ptr& failure = nullptr)
    {
        const auto copyData = [&](detail::Operations& operations) {
            static_cast<Operations&>(operations).newFrame(tileData, pixelData);
        };
        return Frame(*this, beginNext(params, copyData, failure));
    }
};

DFB_NAMESPACE_END
