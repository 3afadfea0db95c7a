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
    bool activeByDepth = false, emptyIsBackground = false, keepsState = false;
    bool opaqueHides = false, readsInPlace = false, takesOrder = false;
    bool hasPixelOp = false, pixelOpIsPointwise = true;
    std::string tileOp, pixelOp; // names of the types, as the compiler has them

    template <class TileOp, class PixelOp>
    static OperationTraits of()
    {
        OperationTraits t;
        t.tileWidth = t.tileHeight = tile_size_v<TileOp>;
        t.channels = TileOp::channels;
        t.neededChannels = needed_channels_v<TileOp>;
        t.activeByDepth = active_by_depth_v<TileOp>;
        t.emptyIsBackground = empty_is_background_v<TileOp>;
        t.keepsState = keeps_state_v<TileOp>;
        t.opaqueHides = opaque_hides_v<TileOp>;
        t.readsInPlace = reads_in_place_v<TileOp>;
        t.takesOrder = takes_order_v<TileOp>;
        t.hasPixelOp = !std::is_same_v<PixelOp, NoPixelOp>;
        t.pixelOpIsPointwise = is_pointwise_v<PixelOp>;
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

// The tile operation and the pixel operation, for one frame at a time.
class Operations {
public:
    virtual ~Operations() = default;

    const OperationTraits& traits() const noexcept { return traits_; }

    // The result must not live longer than this object.
    virtual std::unique_ptr<TileStage> makeTile() const = 0;
    virtual bool opaqueHides(const TileInfo& info) const = 0;
    // Several threads may call it at once.
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

    // Copies the tile operation's data, and calls newFrame() of the pixel operation. Throws the exceptions of both. No
    // other member may be running.
    void newFrame(const TileFrameData& tileData, [[maybe_unused]] const PixelFrameData& pixelData)
    {
        tileData_ = tileData;
        if constexpr (has_pixel_new_frame_v<PixelOp>)
            pixelOp_.newFrame(pixelData);
    }

    std::unique_ptr<TileStage> makeTile() const override
    {
        return std::unique_ptr<TileStage>(new Stage(tileData_)); // make_unique() would be compiled for each operation
    }

    bool opaqueHides([[maybe_unused]] const TileInfo& info) const override
    {
        if constexpr (opaque_hides_v<TileOp>)
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
            if constexpr (has_new_frame_with_data_v<TileOp>)
                op_.newFrame(info, data_);
            else
                op_.newFrame(info);
        }
        void add(Fragment&& fragment) override { op_.add(std::move(fragment)); }
        bool isComplete() const override
        {
            if constexpr (has_is_complete_v<TileOp>)
                return op_.isComplete();
            else
                return false;
        }
        void finish(FinishedTile& out) override { op_.finish(out); }
        TileReport report() const override
        {
            TileReport report;
            if constexpr (has_report_v<TileOp>)
                op_.report(report);
            return report;
        }

    private:
        const TileFrameData& data_;
        TileOp op_;
    };

    PixelOp pixelOp_;
    TileFrameData tileData_{};
};

} // namespace detail
DFB_NAMESPACE_END
