// DirectSend: each rank owns a slice of the image and gets the parts of it that others have.
#pragma once

#include "plain_compositor.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <utility>
#include <vector>

namespace bench {

class DirectSend : public PlainCompositor {
public:
    // `order`: the ranks front to back. `viewports`: of each rank.
    DirectSend(MPI_Comm comm, std::vector<int> order, std::vector<std::array<int, 4>> viewports, int width, int height,
               bool toBytes)
        : PlainCompositor(comm, slices(static_cast<int>(order.size()), height), width, height, toBytes),
          order_(std::move(order)), viewports_(std::move(viewports))
    {
    }

private:
    static std::vector<Rows> slices(int ranks, int height)
    {
        std::vector<Rows> all;
        for (int rank = 0; rank < ranks; ++rank)
            all.push_back({height * rank / ranks, height * (rank + 1) / ranks});
        return all;
    }

    // The part of the slice of `owner` in which `from` may have pixels.
    Part partOf(int from, int owner) const { return overlap(viewports_[static_cast<std::size_t>(from)], slice(owner)); }

    void blendSlice(const std::vector<float>& rgba) override
    {
        constexpr int tag = 1;
        std::vector<MPI_Request> sends, receives;
        for (int other = 0; other < size(); ++other)
            if (const Part there = partOf(other, rank()); other != rank() && there[3] > 0)
                receive(there, other, tag, in(other), receives);
        for (int step = 1; step < size(); ++step) {
            const int other = (rank() + step) % size();
            const Part mine = partOf(rank(), other);
            if (mine[3] <= 0)
                continue;
            pack(rgba, 0, mine, out(other));
            send(out(other), other, tag, sends);
        }
        if (const Part own = partOf(rank(), rank()); own[3] > 0)
            pack(rgba, 0, own, in(rank()));
        waitAll(receives);
        std::fill(sum().begin(), sum().end(), 0.0f);
        for (const int other : order_)
            if (const Part there = partOf(other, rank()); there[3] > 0)
                blend(in(other), there, slice(rank())[0], sum());
        waitAll(sends);
    }

    std::vector<int> order_;
    std::vector<std::array<int, 4>> viewports_;
};

} // namespace bench
