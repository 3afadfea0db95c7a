// How often a pixel is copied: once from the renderer's image into a message, and once from there into the image. 3
// ranks, which are threads.
#include "board.hpp"
#include "catch.hpp"
#include "random_scene.hpp"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <tuple>
#include <utility>
#include <vector>

namespace passes_cases {

namespace {

using board::Board;
using board::BoardTransport;

constexpr int ranks = 3;

// The addresses of pixels in memory.
struct Places {
    std::mutex mutex;
    std::vector<std::pair<const std::byte*, std::size_t>> messages; // messages sent; under mutex, as are the next two
    std::vector<const std::byte*> inputs;                           // inputs that operations got
    std::vector<std::tuple<int, const std::byte*>> finished;        // tile, first row
};
Places* places = nullptr;

// An operation that notes the addresses of its inputs and outputs.
template <class Base>
class Watched : public Base {
public:
    void newFrame(const dfb::TileInfo& info)
    {
        tile_ = info.tile;
        Base::newFrame(info);
    }
    void add(dfb::Fragment&& fragment)
    {
        if (!fragment.empty()) {
            const std::lock_guard<std::mutex> lock(places->mutex);
            places->inputs.push_back(reinterpret_cast<const std::byte*>(fragment.color()));
        }
        Base::add(std::move(fragment));
    }
    void finish(dfb::FinishedTile& out)
    {
        {
            const std::lock_guard<std::mutex> lock(places->mutex);
            places->finished.emplace_back(tile_, out.planes().at[dfb::detail::Color]);
        }
        Base::finish(out);
    }

private:
    int tile_ = -1;
};

template <class TileOp>
void check()
{
    const scene::Scene s = scene::makeScene(5, 4);
    Places seen;
    places = &seen;
    const auto watched = std::make_shared<Board>();
    watched->inspect = [&](int, int, const dfb::detail::MessageHeader& header, dfb::Buffer& message) {
        if (header.kind == dfb::detail::MessageKind::Fragment) {
            const std::lock_guard<std::mutex> lock(seen.mutex);
            seen.messages.emplace_back(message.data(), message.size());
        }
        return Board::What::Pass;
    };
    std::size_t own = 0, finishedInImage = 0, displayed = 0;
    board::runOn(watched, ranks, [&](const BoardTransport::Communicator& communicator) {
        dfb::FrameBufferConfig config = scene::configOf(s);
        dfb::DistributedFrameBuffer<Watched<TileOp>, dfb::NoPixelOp, BoardTransport> fb(communicator, config);
        std::size_t inputsToSelf = 0;
        for (const dfb::Brick& brick : scene::bricksOf(s, fb.rank(), ranks)) {
            const dfb::Region r = scene::FlatCamera().project(brick.bounds, s.width, s.height);
            for (const int tile : fb.ownedTiles())
                inputsToSelf += !dfb::intersection(r, fb.layout().region(tile)).empty();
        }
        scene::renderLoop(fb, s, scene::Loop::Declared);
        const std::lock_guard<std::mutex> lock(seen.mutex);
        own += inputsToSelf;
        if (!fb.isDisplayRank())
            return;
        const std::byte* image = fb.image().bytes();
        const std::size_t bytesPerRow = 16 * static_cast<std::size_t>(s.width);
        for (const auto& [tile, row] : seen.finished)
            if (fb.tileOwner(tile) == fb.rank()) {
                const dfb::Region r = fb.layout().region(tile);
                ++displayed;
                finishedInImage +=
                    row == image + static_cast<std::size_t>(r.y0) * bytesPerRow + 16 * static_cast<std::size_t>(r.x0);
            }
    });
    // Each input is read in the message that its sender has written. This also holds for inputs of a rank to itself,
    // but the board does not see those messages.
    std::size_t inMessages = 0;
    for (const std::byte* input : seen.inputs)
        inMessages += std::any_of(seen.messages.begin(), seen.messages.end(),
                                  [input](const auto& m) { return input >= m.first && input < m.first + m.second; });
    CHECK(seen.inputs.size() > 20);
    CHECK(own < seen.inputs.size());
    CHECK(inMessages >= seen.inputs.size() - own);
    // Tiles that the display rank finishes itself are written directly into the image.
    CHECK(displayed > 3);
    CHECK(finishedInImage == displayed);
}

} // namespace

TEST_CASE("From the renderer to the operation pixels are copied once, and from there to the image once", "[passes]")
{
    check<dfb::BasicAlphaBlend<16>>();
    check<dfb::BasicDepthComposite<16>>();
}

} // namespace passes_cases
