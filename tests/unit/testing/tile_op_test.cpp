// checkTileOp(): it finds no fault in good operations, and each fault of bad ones. PassImages, and the ways in which
// operations and renderers walk pixels.
#include "catch.hpp"

#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/tile_op_test.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <set>
#include <string>
#include <vector>

namespace tile_op_test_cases {

namespace {

using dfb::testing::checkTileOp;

enum class Fault { None, ArrivalOrder, OldState, OtherMean, NoBackground };

// In each pass, keeps the input with the largest alpha. With a fault, it does so wrongly.
template <Fault fault>
class Strongest {
public:
    static constexpr int tileSize = 16;
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;

    void newFrame(const dfb::TileInfo& info)
    {
        if (fault != Fault::OldState || images_.count() == 0)
            images_.newFrame(info);
        if (fault == Fault::NoBackground) {
            dfb::TileInfo without = info;
            without.background = {};
            images_.newFrame(without);
        }
        passes_ = info.passes;
    }
    void add(dfb::Fragment&& fragment)
    {
        fragment.forEachPixel([&](int x, int y, const float* rgba, float) {
            double* pixel = images_.pixel(images_.index(fragment.header().pass, x, y));
            if (static_cast<double>(rgba[3]) > pixel[3] || fault == Fault::ArrivalOrder)
                std::copy_n(rgba, 4, pixel);
        });
    }
    void finish(dfb::FinishedTile& out)
    {
        images_.finish(out);
        std::vector<double> row(4 * static_cast<std::size_t>(out.width()), 0.125 * passes_);
        if (fault == Fault::OtherMean)
            for (int y = 0; y < out.height(); ++y)
                out.setRow(y, row.data(), nullptr);
    }

private:
    dfb::PassImages images_;
    int passes_ = 1;
};

// An operation that does not write its last row.
struct MissesRow {
    static constexpr int tileSize = 16;
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;

    void newFrame(const dfb::TileInfo& info) { background_.assign(info.background.begin(), info.background.end()); }
    void add(dfb::Fragment&&) {}
    void finish(dfb::FinishedTile& out)
    {
        std::vector<double> row;
        for (int x = 0; x < out.width(); ++x)
            row.insert(row.end(), background_.begin(), background_.end());
        for (int y = 0; y + 1 < out.height(); ++y)
            out.setRow(y, row.data(), nullptr);
    }

private:
    std::vector<double> background_;
};

// The nearest input of a pixel; of equally near ones the first that came.
struct EqualDepthsAsTheyCame {
    static constexpr int tileSize = 16;
    static constexpr dfb::ChannelMask channels = dfb::colorChannel | dfb::depthChannel;

    void newFrame(const dfb::TileInfo& info)
    {
        images_.newFrame(info);
        nearest_.assign(images_.count(), std::numeric_limits<float>::infinity());
    }
    void add(dfb::Fragment&& fragment)
    {
        fragment.forEachPixel([&](int x, int y, const float* rgba, float depth) {
            const std::size_t pixel = images_.index(fragment.header().pass, x, y);
            if (depth < nearest_[pixel]) {
                nearest_[pixel] = depth;
                std::copy_n(rgba, 4, images_.pixel(pixel));
            }
        });
    }
    void finish(dfb::FinishedTile& out) { images_.finish(out); }

private:
    dfb::PassImages images_;
    std::vector<float> nearest_;
};

// The strongest input of a pixel, whose id is right or that of the input that came last.
template <bool isRight>
struct WithId {
    static constexpr int tileSize = 16;
    static constexpr dfb::ChannelMask channels = dfb::allChannels;

    void newFrame(const dfb::TileInfo& info)
    {
        images_.newFrame(info);
        depths_.assign(images_.count(), std::numeric_limits<float>::infinity());
        normals_.assign(3 * images_.count(), 0.0f);
        ids_.assign(images_.count(), dfb::noId);
    }
    void add(dfb::Fragment&& fragment)
    {
        fragment.forEachPixel([&](int x, int y, const float* rgba, float depth, const dfb::FragmentRow& row, int k) {
            const std::size_t i = images_.index(fragment.header().pass, x, y);
            const bool isStronger = static_cast<double>(rgba[3]) > images_.pixel(i)[3];
            if (isStronger || !isRight)
                ids_[i] = row.instanceId()[k];
            if (!isStronger)
                return;
            std::copy_n(rgba, 4, images_.pixel(i));
            std::copy_n(row.normal() + 3 * k, 3, normals_.begin() + static_cast<std::ptrdiff_t>(3 * i));
            depths_[i] = depth;
        });
    }
    void finish(dfb::FinishedTile& out)
    {
        dfb::AuxRow aux;
        aux.normal = normals_.data();
        aux.instanceId = ids_.data();
        images_.finish(out, depths_.data(), aux);
    }

private:
    dfb::PassImages images_;
    std::vector<float> depths_, normals_;
    std::vector<std::uint32_t> ids_;
};

struct WithFrameData : Strongest<Fault::None> {
    struct FrameData {};
    void newFrame(const dfb::TileInfo& info, const FrameData&) { Strongest::newFrame(info); }
};

template <Fault fault>
bool finds(const char* sentence)
{
    return checkTileOp<Strongest<fault>>().find(sentence) != std::string::npos;
}

} // namespace

TEST_CASE("checkTileOp() finds nothing wrong with good operations", "[tile_op_test]")
{
    CHECK(checkTileOp<Strongest<Fault::None>>() == "");
    CHECK(checkTileOp<WithFrameData>() == "");
    CHECK(checkTileOp<WithId<true>>() == "");
    CHECK(checkTileOp<dfb::BasicAlphaBlend<16, dfb::allChannels>>() == "");
    CHECK(checkTileOp<dfb::AlphaBlend>() == "");
    CHECK(checkTileOp<dfb::DepthComposite>() == "");
    const auto inOrder = [](dfb::TileHeader& header, int layer) {
        header.generation = layer + 1;
        header.children = layer < 2;
    };
    CHECK(checkTileOp<dfb::OrderedBlend>(inOrder, 7) == "");
}

TEST_CASE("checkTileOp() finds what a bad operation does wrong", "[tile_op_test]")
{
    CHECK(finds<Fault::ArrivalOrder>("order in which inputs come"));
    CHECK(finds<Fault::OldState>("the frame before"));
    CHECK(finds<Fault::OtherMean>("not the mean"));
    CHECK(finds<Fault::NoBackground>("the background does not show"));
    CHECK(checkTileOp<EqualDepthsAsTheyCame>(2).find("order in which inputs come") != std::string::npos);
    CHECK(checkTileOp<WithId<false>>().find("order in which inputs come") != std::string::npos);
    CHECK(checkTileOp<MissesRow>().find("Not each pixel") != std::string::npos);
}

TEST_CASE("Tile::forEachPixel() gives the number of a pixel as the last argument", "[tile_op_test]")
{
    using Deep = dfb::Tile<dfb::colorChannel | dfb::depthChannel | dfb::normalChannel, 16>;
    const auto deep = std::make_unique<Deep>();
    const auto flat = std::make_unique<dfb::Tile<dfb::colorChannel | dfb::normalChannel, 16>>();
    deep->region = flat->region = {16, 32, 27, 41};
    deep->clear();
    flat->clear();
    std::set<int> numbers;
    deep->forEachPixel([&](int x, int y, float* rgba, float& depth, int i) {
        numbers.insert(i);
        CHECK((rgba == deep->pixel(x - 16, y - 32) && &depth == deep->depth + i && rgba == deep->color + 4 * i));
    });
    CHECK(numbers.size() == 11 * 9);
    int count = 0;
    flat->forEachPixel([&](int x, int y, float* rgba, int i) {
        ++count;
        CHECK((rgba == flat->pixel(x - 16, y - 32) && rgba == flat->color + 4 * i));
    });
    CHECK(count == 11 * 9);
}

} // namespace tile_op_test_cases
