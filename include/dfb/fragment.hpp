// Fragment: one input of a tile: its header, and the active pixels of each channel. It owns the message that brought
// it, and its pixels are read there; or it is a view of pixels in the memory of a renderer (TileView::staysUntilEnd).
// Any thread may call const members.
#pragma once

#include <dfb/tile.hpp>
#include <dfb/wire/active_pixels.hpp>
#include <dfb/wire/wire_format.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <type_traits>
#include <utility>

DFB_NAMESPACE_BEGIN

// The active pixels of one row. Pixel k of the row's active pixels (over all its spans, left to right) has its colour
// at color + 4 * k and its depth at depth + k. Channels that did not travel are null.
struct FragmentRow {
    const Span* spans = nullptr;
    const float* color = nullptr;
    int spanCount = 0; // between two pointers: compilers would read these at once, which is slow just after next()
    const float* depth = nullptr;
    detail::ConstPlanes aux; // all channels but colour and depth

    const float* normal() const noexcept { return detail::floatsOf(aux.at[detail::Normal]); }     // 3 a pixel
    const float* albedo() const noexcept { return detail::floatsOf(aux.at[detail::Albedo]); }     // 3 a pixel
    const float* position() const noexcept { return detail::floatsOf(aux.at[detail::Position]); } // 3 a pixel
    const std::uint32_t* primitiveId() const noexcept { return detail::idsOf(aux.at[detail::PrimitiveId]); }
    const std::uint32_t* instanceId() const noexcept { return detail::idsOf(aux.at[detail::InstanceId]); }
    const float* farDepth() const noexcept { return detail::floatsOf(aux.at[detail::Far]); }
};

// How the pixels of a fragment are stored.
enum class FragmentEncoding : std::uint8_t {
    Empty,    // no active pixel: "nothing here"
    Sparse,   // row spans
    Dense,    // every pixel of the region, no spans
    Constant, // all pixels of the region are equal: one is stored
    InPlace   // read in the memory of its renderer; active pixels are found row by row
};

class Fragment {
public:
    // The parts of a decoded message. They are made and checked by detail::decodeFragment.
    struct Parts {
        FragmentEncoding encoding = FragmentEncoding::Empty;
        int rowBegin = 0, rowEnd = 0;                 // the range of rows with active pixels, from the region's top
        std::uint32_t activePixels = 0;               // all that contribute, even if fewer are stored
        const std::uint16_t* rowSpanCounts = nullptr; // Sparse: one per row in [rowBegin, rowEnd)
        const Span* spans = nullptr;                  // Sparse: all spans, row by row; else null
        ChannelMask channels = colorChannel;
        WireFormat colorFormat = WireFormat::Float32; // in which the colour travelled
        const float* color = nullptr;
        const std::byte* bytes = nullptr; // instead of `color`: 4 bytes a pixel
        const float* depth = nullptr;
        detail::ConstPlanes aux;               // all channels but colour and depth
        Span fullRow;                          // Dense and Constant
        detail::PixelsInPlace inPlace;         // InPlace
        detail::FaultCounts* faults = nullptr; // InPlace: the counts of all inputs of the rank
    };

    Fragment() = default;
    Fragment(const TileHeader& header, Buffer&& storage, const Parts& parts)
        : header_(header), storage_(std::move(storage)), parts_(parts)
    {
    }

    const TileHeader& header() const noexcept { return header_; }
    bool empty() const noexcept { return parts_.encoding == FragmentEncoding::Empty; }
    std::uint32_t activePixels() const noexcept { return parts_.activePixels; } // InPlace: 0, as it is not known
    // Whether the pixels have 8 bits a channel. FragmentCursor::nextBytes() may be called only then.
    bool keepsBytes() const noexcept { return parts_.bytes || parts_.inPlace.activity.hasBytes; }
    // Whether FragmentCursor converts or copies each row.
    bool isMadeByRow() const noexcept { return parts_.bytes || parts_.encoding == FragmentEncoding::InPlace; }
    bool hasDepth() const noexcept { return parts_.depth != nullptr || parts_.inPlace.depth != nullptr; }
    ChannelMask channels() const noexcept { return parts_.channels; } // those that travelled
    FragmentEncoding encoding() const noexcept { return parts_.encoding; }
    WireFormat colorFormat() const noexcept { return parts_.colorFormat; } // in which the colour travelled

    // The colours of the storedPixels() pixels: the active ones, or with FragmentEncoding::Constant one row of equal
    // pixels. Null with FragmentEncoding::InPlace, and if the pixels came as bytes in an operation with readsInPlace.
    // forEachPixel() and FragmentCursor can read all of these.
    const float* color() const noexcept { return parts_.color; }
    std::size_t storedPixels() const noexcept
    {
        return parts_.encoding == FragmentEncoding::Constant ? parts_.fullRow.count : parts_.activePixels;
    }

    // Whether nothing behind the fragment can be seen: alpha is 1 in all pixels of the region. Stops at the first pixel
    // that is not opaque.
    bool isOpaque() const noexcept
    {
        if (parts_.encoding == FragmentEncoding::InPlace)
            return parts_.inPlace.isOpaque(header_.region.width(), header_.region.height());
        if (parts_.encoding != FragmentEncoding::Dense && parts_.encoding != FragmentEncoding::Constant)
            return false;
        const auto* color = parts_.bytes ? parts_.bytes : reinterpret_cast<const std::byte*>(parts_.color);
        return detail::isOpaque(color, parts_.bytes != nullptr, static_cast<int>(storedPixels()), 1, 0);
    }

    // Calls f(x, y, rgba, depth) for each active pixel, row by row. x and y count from the tile's upper left corner,
    // `rgba` points to 4 floats, and depth is +infinity if no depth travelled. To read other channels, f may take two
    // more arguments: the FragmentRow, and the pixel's index k in it, as in row.normal() + 3 * k.
    template <class F>
    void forEachPixel(const F& f) const;

private:
    friend class FragmentCursor;
    TileHeader header_;
    Buffer storage_;
    Parts parts_;
};

// The pixels of a row with 8 bits a channel, read where they lie. Like FragmentRow, with `bytes` instead of colours.
// Pixels whose depth is not below the limit, and pixels that are 0, are not active.
struct ByteRow : FragmentRow {
    const std::byte* bytes = nullptr;
    float depthLimit = std::numeric_limits<float>::infinity();
    Span valid; // the one span of a fragment in place
};

// Walks the rows of a fragment from top to bottom. The fragment must outlive it. One thread at a time may use it.
class FragmentCursor {
public:
    // `row` is scratch memory for a fragment that isMadeByRow(); if it is null, the cursor allocates its own.
    // `countsFaults`: whether faults of pixels in place, such as NaN, are added to FrameReport. Set it for only one
    // walk of a fragment.
    explicit FragmentCursor(const Fragment& fragment, detail::RowPixels* row = nullptr, bool countsFaults = false)
        : parts_(&fragment.parts_), span_(fragment.parts_.spans), color_(fragment.parts_.color),
          bytes_(fragment.parts_.bytes), depth_(fragment.parts_.depth), aux_(fragment.parts_.aux),
          faults_(countsFaults ? fragment.parts_.faults : nullptr), rowPixels_(row)
    {
        if (!row && fragment.isMadeByRow()) {
            ownRow_ = std::make_unique<detail::RowPixels>();
            rowPixels_ = ownRow_.get();
        }
    }

    // The active pixels of the next row of the region, starting with row 0; a row may have none. If the fragment
    // isMadeByRow(), they are valid until the next call.
    FragmentRow next()
    {
        FragmentRow row;
        if (next(row))
            row.aux = aux_;
        advance(row);
        return row;
    }

    // Goes to the next row, and sets the colour and depth of `result`, but no other channel. Returns false if the row
    // has no pixels. advance(row) must follow.
    bool next(FragmentRow& result)
    {
        const int row = row_++;
        result.spanCount = 0;
        if (isInPlace()) {
            detail::InputFaults faults;
            parts_->inPlace.readRow(row, *rowPixels_, faults);
            if (faults_)
                faults_->add(faults);
            result.spans = rowPixels_->active.spans.data();
            result.spanCount = static_cast<int>(rowPixels_->active.spans.size());
            result.color = rowPixels_->color.data();
            result.depth = parts_->inPlace.depth ? rowPixels_->depth.data() : nullptr;
        } else if (findRow(row, result)) {
            result.color = bytes_ ? decodeRow(result) : color_;
        }
        return result.spanCount > 0;
    }
    // Like next(result), but sets bytes instead of colours. Only for a fragment that keepsBytes(). Pixels in place are
    // not checked, and some may be empty.
    bool nextBytes(ByteRow& result)
    {
        const int row = row_++;
        if (!isInPlace()) {
            result.bytes = bytes_;
            result.depthLimit = std::numeric_limits<float>::infinity();
            return findRow(row, result);
        }
        detail::RowInPlace its;
        if (!findPlaces(row, its))
            return false;
        its.ahead.prefetchAll(its.span.count, 4);
        result.valid = its.span;
        result.spans = &result.valid;
        result.spanCount = 1;
        result.bytes = its.first.color;
        result.depth = its.first.depth;
        result.depthLimit = parts_->inPlace.activity.depthLimit;
        return true;
    }
    // Adds `count` NaN depths that the caller of nextBytes() has found to the frame's counts.
    void countNanDepths(std::uint64_t count)
    {
        if (count > 0 && faults_)
            faults_->add({count, 0});
    }
    const detail::ConstPlanes& aux() const noexcept { return aux_; } // of the row that next() returned

    // Sets `row` to where the next row lies, if it is read in place, without moving on; skip(1) moves on. Returns false
    // if the row has no pixels, is not in place, or must be converted.
    bool findInPlace(detail::RowInPlace& row) const
    {
        return isInPlace() && parts_->inPlace.activity.byColorAlone() && findPlaces(row_, row);
    }

    void advance(const FragmentRow& row)
    {
        if (parts_->encoding == FragmentEncoding::Constant || isInPlace())
            return;
        const std::size_t pixels = pixelsIn(row);
        if (parts_->encoding == FragmentEncoding::Sparse)
            span_ += row.spanCount;
        if (bytes_)
            bytes_ += 4 * pixels;
        else
            color_ += 4 * pixels;
        if (depth_)
            depth_ += pixels;
        if ((parts_->channels & ~(colorChannel | depthChannel)) != 0)
            aux_.advance(pixels);
    }

    // Skips `count` rows.
    void skip(int count)
    {
        for (const int end = row_ + count; row_ < end; ++row_) {
            FragmentRow row;
            if (!isInPlace() && findRow(row_, row))
                advance(row);
        }
    }

private:
    bool isInPlace() const noexcept { return parts_->encoding == FragmentEncoding::InPlace; }

    static std::size_t pixelsIn(const FragmentRow& row)
    {
        std::size_t pixels = 0;
        for (int i = 0; i < row.spanCount; ++i)
            pixels += row.spans[i].count;
        return pixels;
    }

    // For pixels in place: sets `result` to row `row`. False if the row has no pixels.
    bool findPlaces(int row, detail::RowInPlace& result) const
    {
        const detail::PixelsInPlace& pixels = parts_->inPlace;
        const Region& valid = pixels.valid;
        if (row < valid.y0 || row >= valid.y1)
            return false;
        result.span = {static_cast<std::uint16_t>(valid.x0), static_cast<std::uint16_t>(valid.width())};
        result.first = pixels.at(valid.x0, row);
        result.ahead = pixels.at(valid.x0, detail::rowAhead(row, valid.y1, valid.width()));
        return true;
    }

    // Sets all but the colour and the auxiliary channels, for pixels that are not in place. False if the row has none.
    bool findRow(int row, FragmentRow& result) const
    {
        if (parts_->encoding == FragmentEncoding::Empty || row < parts_->rowBegin || row >= parts_->rowEnd)
            return false;
        const bool isSparse = parts_->encoding == FragmentEncoding::Sparse;
        result.spans = isSparse ? span_ : &parts_->fullRow;
        result.spanCount = isSparse ? parts_->rowSpanCounts[row - parts_->rowBegin] : 1;
        result.depth = depth_;
        return result.spanCount > 0;
    }

    const float* decodeRow(const FragmentRow& row)
    {
        const std::size_t pixels = pixelsIn(row);
        rowPixels_->color.resize(std::max(rowPixels_->color.size(), 4 * pixels));
        detail::bytesToFloats(bytes_, pixels, rowPixels_->color.data());
        return rowPixels_->color.data();
    }

    const Fragment::Parts* parts_;
    const Span* span_;
    const float* color_;
    const std::byte* bytes_;
    const float* depth_;
    detail::ConstPlanes aux_;
    detail::FaultCounts* faults_; // null: they are not counted
    int row_ = 0;
    detail::RowPixels* rowPixels_; // of the row that next() returned
    std::unique_ptr<detail::RowPixels> ownRow_;
};

template <class F>
void Fragment::forEachPixel(const F& f) const
{
    FragmentCursor cursor(*this);
    for (int y = 0; y < header_.region.height(); ++y) {
        const FragmentRow row = cursor.next();
        int k = 0;
        for (const Span* span = row.spans; span != row.spans + row.spanCount; ++span)
            for (int x = span->x; x < span->x + span->count; ++x, ++k) {
                const float depth = row.depth ? row.depth[k] : std::numeric_limits<float>::infinity();
                if constexpr (std::is_invocable_v<const F&, int, int, const float*, float, const FragmentRow&, int>)
                    f(x, y, row.color + 4 * k, depth, row, k);
                else
                    f(x, y, row.color + 4 * k, depth);
            }
    }
}

DFB_NAMESPACE_END
