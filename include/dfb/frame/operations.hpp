// Operations: a tile operation and a pixel operation of any type, behind one abstract class. Code that uses it is no
// template: it costs a virtual call per input and a few per tile, while the loops over pixels stay in the operation.
#pragma once

#include <dfb/pixel_op.hpp>
#include <dfb/tile_op.hpp>

#include <memory>
#include <string>
#include <type_traits>
#include <typeinfo>
#include <utility>

DFB_NAMESPACE_BEGIN
namespace detail {

// The traits of a tile operation and a pixel operation; see tile_op.hpp and pixel_op.hpp.
struct OperationTraits {
    int tileWidth = 64, tileHeight = 64;
    ChannelMask channels = 0, neededChannels = 0;
    bool activeByDepth = false, emptyIsBackground = false, keepsState = false, endsEarly = false;
    bool opaqueHides = false, reports = false, readsInPlace = false;
    bool hasPixelOp = false, pixelOpIsPointwise = true;
    std::string tileOp, pixelOp; // names of the types, as the compiler has them

    template <class TileOp, class PixelOp>
    static OperationTraits of()
    {
        OperationTraits t;
        t.tileWidth = t.tileHeight = TileSizeOf<TileOp>::value;
        t.channels = TileOp::channels;
        t.neededChannels = NeededChannelsOf<TileOp>::value;
        t.activeByDepth = ActiveByDepth<TileOp>::value;
        t.emptyIsBackground = EmptyIsBackground<TileOp>::value;
        t.keepsState = KeepsState<TileOp>::value;
        t.endsEarly = HasIsComplete<TileOp>::value;
        t.opaqueHides = OpaqueHides<TileOp>::value;
        t.readsInPlace = ReadsInPlace<TileOp>::value;
        t.reports = HasReport<TileOp>::value;
        t.hasPixelOp = !std::is_same_v<PixelOp, NoPixelOp>;
        t.pixelOpIsPointwise = IsPointwise<PixelOp>::value;
        t.tileOp = typeid(TileOp).name();
        t.pixelOp = typeid(PixelOp).name();
        return t;
    }
};

// The tile operation of one tile.
class TileStage {
public:
    virtual ~TileStage() = default;

    virtual void newFrame(const TileInfo& info) = 0; // with the frame's data, see Operations
    virtual void add(Fragment&& fragment) = 0;
    virtual bool isComplete() const = 0; // false if the operation never ends early
    virtual void finish(FinishedTile& out) = 0;
    virtual TileReport report() const = 0;
};

// Both operations of one frame at a time.
class Operations {
public:
    virtual ~Operations() = default;

    const OperationTraits& traits() const noexcept { return traits_; }

    // With copies of the data given to begin(). Throws the exceptions of the copies and of the pixel operation. No
    // other member may be running.
    virtual void newFrame() = 0;
    // Must not live longer than this object.
    virtual std::unique_ptr<TileStage> makeTile() const = 0;
    virtual bool opaqueHides(const TileInfo& info) const = 0;
    // From several threads at once.
    virtual void process(PixelTile& tile) const = 0;

protected:
    explicit Operations(OperationTraits traits) : traits_(std::move(traits)) {}

private:
    OperationTraits traits_;
};

template <class TileOp, class PixelOp>
class OperationsOf final : public Operations {
public:
    using TileFrameData = typename FrameDataOf<TileOp>::type;
    using PixelFrameData = typename FrameDataOf<PixelOp>::type;

    explicit OperationsOf(PixelOp pixelOp, OperationTraits traits = OperationTraits::of<TileOp, PixelOp>())
        : Operations(std::move(traits)), pixelOp_(std::move(pixelOp))
    {
    }

    // Offers the frame data that the next newFrame() copies. Both objects must live until then.
    void offer(const TileFrameData& tileData, const PixelFrameData& pixelData)
    {
        offeredTileData_ = &tileData;
        offeredPixelData_ = &pixelData;
    }

    void newFrame() override
    {
        tileData_ = *offeredTileData_;
        if constexpr (HasPixelNewFrame<PixelOp>::value)
            pixelOp_.newFrame(*offeredPixelData_);
    }

    std::unique_ptr<TileStage> makeTile() const override { return std::make_unique<Stage>(tileData_); }

    bool opaqueHides([[maybe_unused]] const TileInfo& info) const override
    {
        if constexpr (OpaqueHides<TileOp>::value)
            return TileOp::opaqueHides(info);
        else
            return false;
    }

    void process(PixelTile& tile) const override { pixelOp_.process(tile); }

private:
    class Stage final : public TileStage {
    public:
        explicit Stage(const TileFrameData& data) : data_(data) {}

        void newFrame(const TileInfo& info) override
        {
            if constexpr (HasNewFrameWithData<TileOp>::value)
                op_.newFrame(info, data_);
            else
                op_.newFrame(info);
        }
        void add(Fragment&& fragment) override { op_.add(std::move(fragment)); }
        bool isComplete() const override
        {
            if constexpr (HasIsComplete<TileOp>::value)
                return op_.isComplete();
            else
                return false;
        }
        void finish(FinishedTile& out) override { op_.finish(out); }
        TileReport report() const override
        {
            TileReport report;
            if constexpr (HasReport<TileOp>::value)
                op_.report(report);
            return report;
        }

    private:
        const TileFrameData& data_;
        TileOp op_;
    };

    PixelOp pixelOp_;
    TileFrameData tileData_{};
    const TileFrameData* offeredTileData_ = nullptr;
    const PixelFrameData* offeredPixelData_ = nullptr;
};

} // namespace detail
DFB_NAMESPACE_END
