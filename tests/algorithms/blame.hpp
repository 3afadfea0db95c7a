// What errors name: the rank, the setting and its values, the input; on every rank alike, and the next frame is right.
#pragma once

#include "everywhere.hpp"

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace algorithms {

template <class Transport>
using BlameFrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport>;

// "rank 2"
inline std::string rankText(int rank) { return "rank " + std::to_string(rank); }

inline void expectText(Result& result, const std::string& what, const std::string& text,
                       const std::vector<std::string>& parts)
{
    for (const std::string& part : parts)
        result.expect(scene::has(text, part), what + ": no \"" + part + "\" in: " + text);
}

// A good frame, compared with the reference.
template <class Fb>
void expectGoodFrame(Result& result, Fb& fb, const scene::Scene& s, const std::string& what)
{
    const std::string text = scene::outcomeOf([&] {
        const auto report = scene::renderLoop(fb, s, scene::Loop::Declared);
        if (fb.isDisplayRank())
            result.expect(wrongValues(scene::Picture(fb.image(), report), referenceOf(s)) == 0,
                          "a wrong image after " + what);
    });
    result.expect(text == "fine", "after " + what + ": " + text);
}

// The first and the last rank in turn are the odd one.
inline std::vector<int> oddRanks(int size) { return size > 1 ? std::vector<int>{0, size - 1} : std::vector<int>{}; }

// A camera that breaks on one rank.
struct BrokenCamera : scene::FlatCamera {
    bool isBroken = false;
    dfb::Region project(const dfb::Box3& b, int w, int h) const
    {
        if (isBroken)
            throw std::runtime_error("the lens is gone");
        return FlatCamera::project(b, w, h);
    }
};

// Exceptions between begin() and end().
struct BlamedLoop {
    template <class Transport>
    static Result run(const typename Transport::Communicator& communicator)
    {
        using Fb = BlameFrameBuffer<Transport>;
        Result result;
        const scene::Scene s = scene::makeScene(3);
        Fb fb(communicator, configOf(s));
        const auto tile = std::make_unique<typename Fb::Tile>();
        for (const int culprit : {0, fb.size() / 2, fb.size() - 1})
            for (const bool named : {false, true}) {
                std::int64_t number = 0;
                bool through = false;
                const std::string text = scene::outcomeOf([&] {
                    auto frame = fb.begin();
                    number = frame.number();
                    const auto renderAll = [&] {
                        for (const int index : fb.ownedTiles()) {
                            frame.start(*tile, index);
                            if (fb.rank() == culprit)
                                throw std::runtime_error("out of paint");
                            frame.setTile(*tile);
                        }
                    };
                    through = named ? frame.guard(renderAll, *tile) : frame.guard(renderAll);
                    frame.end();
                });
                const std::string where = named ? ", tile " : ": out of paint";
                expectText(result, "an own loop", text,
                           {"FrameError: dfb: exception in user code: " + rankText(culprit) + ", frame "
                                + std::to_string(number) + where,
                            ": out of paint"});
                result.expect(through == (fb.rank() != culprit), "guard() returned the wrong thing");
                expectGoodFrame(result, fb, s, "an exception in an own loop");
            }
        for (const int culprit : oddRanks(fb.size())) {
            BrokenCamera camera;
            camera.isBroken = fb.rank() == culprit;
            const dfb::World world(scene::bricksOf(scene::makeScene(fb.size()), fb.rank(), fb.size()));
            const std::string text =
                scene::outcomeOf([&] { dfb::renderDataParallel(fb, world, camera, [](const dfb::Brick&, auto&) {}); });
            expectText(result, "a camera", text,
                       {"FrameError: dfb: exception in user code: " + rankText(culprit), ": the lens is gone"});
            expectGoodFrame(result, fb, s, "a broken camera");
        }
        return result;
    }
};

// In blame.cpp, so that the tests over MPI need not compile them again.
extern template Result inProcess<BlamedLoop>(int);

} // namespace algorithms

#if !defined(ALGORITHMS_WITHOUT_TESTS)
TEST_CASE("An exception between begin() and end() is told to all ranks", "[blame]")
{
    everywhere<algorithms::BlamedLoop>();
}
#endif
