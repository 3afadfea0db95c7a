// RadixK: the ranks, in their order front to back, exchange parts of the image in rounds: in a round of factor k, k
// ranks that have the same rows share them out, and each blends its share. With all factors 2 that is binary swap.
#pragma once

#include "plain_compositor.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <utility>
#include <vector>

namespace bench {

class RadixK : public PlainCompositor {
public:
    // `order`: the ranks front to back. `viewports`: of each rank. The product of the factors is the number of ranks.
    RadixK(MPI_Comm comm, std::vector<int> order, std::vector<std::array<int, 4>> viewports, int width, int height,
           std::vector<int> factors, bool toBytes)
        : PlainCompositor(comm, slices(order, height, factors), width, height, toBytes), height_(height),
          order_(std::move(order)), viewports_(std::move(viewports)), factors_(std::move(factors))
    {
    }

    // Factors up to `most`, the greatest first; a prime factor above `most` is kept as it is.
    static std::vector<int> factorsOf(int ranks, int most)
    {
        std::vector<int> factors;
        while (ranks > 1) {
            int factor = std::min(most, ranks);
            while (factor > 1 && ranks % factor != 0)
                --factor;
            for (int prime = most + 1; factor == 1; ++prime)
                factor = ranks % prime == 0 ? prime : 1;
            factors.push_back(factor);
            ranks /= factor;
        }
        return factors;
    }

private:
    // The share i of k.
    static Rows share(const Rows& rows, int i, int k)
    {
        const int count = rows[1] - rows[0];
        return {rows[0] + count * i / k, rows[0] + count * (i + 1) / k};
    }

    static std::vector<Rows> slices(const std::vector<int>& order, int height, const std::vector<int>& factors)
    {
        std::vector<Rows> all(order.size());
        for (std::size_t place = 0; place < order.size(); ++place) {
            Rows rows{0, height};
            int digits = static_cast<int>(place);
            for (const int k : factors) {
                rows = share(rows, digits % k, k);
                digits /= k;
            }
            all[static_cast<std::size_t>(order[place])] = rows;
        }
        return all;
    }

    // The part of the image in which the ranks at `count` places from `first` on may have pixels.
    Part viewportOf(int first, int count) const
    {
        Part all{};
        for (int place = first; place < first + count; ++place) {
            const Part& v = viewports_[static_cast<std::size_t>(order_[static_cast<std::size_t>(place)])];
            if (v[2] <= 0 || v[3] <= 0)
                continue;
            if (all[2] == 0) {
                all = v;
                continue;
            }
            const int x1 = std::max(all[0] + all[2], v[0] + v[2]), y1 = std::max(all[1] + all[3], v[1] + v[3]);
            all[0] = std::min(all[0], v[0]), all[1] = std::min(all[1], v[1]);
            all[2] = x1 - all[0], all[3] = y1 - all[1];
        }
        return all;
    }

    void blendSlice(const std::vector<float>& rgba) override
    {
        const auto own = static_cast<int>(std::find(order_.begin(), order_.end(), rank()) - order_.begin());
        Rows rows{0, height_};
        int stride = 1; // the images of so many adjacent ranks are blended already
        for (std::size_t round = 0; round < factors_.size(); ++round) {
            const auto tag = static_cast<int>(round) + 1;
            const int k = factors_[round], me = own / stride % k, first = own - me * stride;
            const std::vector<float>& source = round == 0 ? rgba : sum();
            const auto rankOf = [&](int i) { return order_[static_cast<std::size_t>(first + i * stride)]; };
            std::vector<MPI_Request> requests;
            std::vector<Part> parts; // of this rank's share, from each
            for (int i = 0; i < k; ++i) {
                const Part theirs = viewportOf((first + i * stride) / stride * stride, stride);
                parts.push_back(overlap(theirs, share(rows, me, k)));
                if (i != me && parts.back()[3] > 0)
                    receive(parts.back(), rankOf(i), tag, in(i), requests);
            }
            const Part mine = viewportOf(own / stride * stride, stride);
            for (int step = 0; step < k; ++step) {
                const int i = (me + step) % k;
                const Part part = overlap(mine, share(rows, i, k));
                if (part[3] <= 0)
                    continue;
                pack(source, rows[0], part, i == me ? in(i) : out(i));
                if (i != me)
                    send(out(i), rankOf(i), tag, requests);
            }
            waitAll(requests);
            rows = share(rows, me, k);
            sum().assign(4 * pixelsOf(rows), 0.0f);
            for (int i = 0; i < k; ++i)
                if (const Part& part = parts[static_cast<std::size_t>(i)]; part[3] > 0)
                    blend(in(i), part, rows[0], sum());
            stride *= k;
        }
        if (factors_.empty())
            sum() = rgba;
    }

    int height_;
    std::vector<int> order_;
    std::vector<std::array<int, 4>> viewports_;
    std::vector<int> factors_;
};

} // namespace bench
