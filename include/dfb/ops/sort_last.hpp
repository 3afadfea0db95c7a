// AlphaBlend: sort-last compositing of transparent fragments, per pixel in order of (depth, source, part)
// (Listing 4 of the paper).
#pragma once

#include <dfb/compositing.hpp>
#include <dfb/tile_op.hpp>

#include <algorithm>
#include <cstddef>
#include <limits>
#include <tuple>
#include <utility>
#include <vector>

namespace dfb {

namespace detail {

// The inputs of one tile, kept until they are all there; then composited pass by pass over the background, and
// the passes averaged, in double.
class FragmentStore {
public:
    void newFrame(const TileInfo& info)
    {
        info_ = info;
        fragments_.clear();
    }

    void add(Fragment&& fragment)
    {
        if (!fragment.empty())
            fragments_.push_back(std::move(fragment));
    }

    void finish(FinishedTile& out)
    {
        static thread_local Scratch scratch; // so that a frame after the first allocates nothing
        std::sort(fragments_.begin(), fragments_.end(), [](const Fragment& a, const Fragment& b) {
            const TileHeader &x = a.header(), &y = b.header();
            return std::tie(x.pass, x.source, x.part, x.generation) < std::tie(y.pass, y.source, y.part, y.generation);
        });
        const std::size_t passes = static_cast<std::size_t>(info_.passes);
        scratch.compositors.resize(std::max(scratch.compositors.size(), passes));
        std::size_t next = 0;
        for (std::size_t pass = 0; pass < passes; ++pass) {
            scratch.pointers.clear();
            for (; next < fragments_.size() && static_cast<std::size_t>(fragments_[next].header().pass) == pass; ++next)
                scratch.pointers.push_back(&fragments_[next]);
            scratch.compositors[pass].start(scratch.pointers.begin(), scratch.pointers.end());
        }
        const float background[4] = {info_.background[0], info_.background[1], info_.background[2],
                                     info_.background[3]};
        for (int y = 0; y < out.height(); ++y) {
            for (std::size_t pass = 0; pass < passes; ++pass) {
                scratch.row.reset(out.width());
                scratch.compositors[pass].nextRow(scratch.row);
                overConstant(scratch.row, background);
                if (passes > 1)
                    accumulate(scratch, pass == 0);
            }
            if (passes > 1) {
                for (double& value : scratch.sum)
                    value /= static_cast<double>(passes);
                out.setRow(y, scratch.sum.data(), scratch.nearest.data());
            } else {
                out.setRow(y, scratch.row.rgba.data(), scratch.row.depth.data());
            }
        }
        fragments_.clear();
    }

private:
    struct Scratch {
        std::vector<const Fragment*> pointers;
        std::vector<FragmentCompositor> compositors;
        CompositeRow row;
        std::vector<double> sum;
        std::vector<float> nearest;
    };

    static void accumulate(Scratch& s, bool first)
    {
        if (first) {
            s.sum = s.row.rgba;
            s.nearest = s.row.depth;
            return;
        }
        for (std::size_t i = 0; i < s.sum.size(); ++i)
            s.sum[i] += s.row.rgba[i];
        for (std::size_t i = 0; i < s.nearest.size(); ++i)
            s.nearest[i] = std::min(s.nearest[i], s.row.depth[i]);
    }

    TileInfo info_;
    std::vector<Fragment> fragments_;
};

} // namespace detail

// Accepts any tree. Empty inputs (a background tile that only announces children, "nothing here") count for the tree
// and cost nothing. Accuracy: see compositing.hpp; the mean over n passes adds at most n * 2^-53 relative.
template <int TileSize = 64>
class BasicAlphaBlend {
public:
    static constexpr int tileSize = TileSize;
    static constexpr ChannelMask channels = colorChannel | depthChannel;

    void newFrame(const TileInfo& info) { store_.newFrame(info); }
    void add(Fragment&& fragment) { store_.add(std::move(fragment)); }
    void finish(FinishedTile& out) { store_.finish(out); }

private:
    detail::FragmentStore store_;
};

using AlphaBlend = BasicAlphaBlend<>;
static_assert(is_tile_op_v<AlphaBlend>);

} // namespace dfb
