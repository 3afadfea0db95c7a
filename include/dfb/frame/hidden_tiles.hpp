// HiddenTiles: from which generation on the inputs of a tile cannot be seen, as an opaque one is in front of them.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

namespace dfb::detail {

// One per rank: what it has heard. newFrame() apart, members may be called from any thread.
class HiddenTiles {
public:
    struct Message {
        std::int32_t tile = 0;
        std::int32_t generation = 0; // the first that is hidden
    };

    void newFrame(int tileCount)
    {
        if (from_.size() != static_cast<std::size_t>(tileCount))
            from_ = std::vector<std::atomic<std::int32_t>>(static_cast<std::size_t>(tileCount));
        else if (!any_)
            return;
        for (auto& from : from_)
            from = none;
        any_ = false;
    }

    int from(int tile) const { return any_ ? from_[static_cast<std::size_t>(tile)].load() : none; }

    void hide(int tile, std::int32_t generation)
    {
        auto& from = from_[static_cast<std::size_t>(tile)];
        std::int32_t before = from;
        while (generation < before && !from.compare_exchange_weak(before, generation)) {
        }
        any_ = true;
    }

private:
    static constexpr std::int32_t none = std::numeric_limits<std::int32_t>::max();
    std::vector<std::atomic<std::int32_t>> from_;
    std::atomic<bool> any_{false};
};

} // namespace dfb::detail
