// MemoryLimit: the least memory traffic with which one image can be made of those of all ranks on one node. Each rank
// reads its part of the image once, and the part of the final image that has anything is written once, shared out over
// the ranks. Nothing is blended or sent.
#pragma once

#include "baselines.hpp"
#include "brick_images.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace bench {

class MemoryLimit {
public:
    // `viewports`: of all ranks.
    MemoryLimit(MPI_Comm comm, const std::vector<std::array<int, 4>>& viewports, bool toBytes) : comm_(comm)
    {
        int x0 = 1 << 30, y0 = x0, x1 = 0, y1 = 0;
        for (const auto& [x, y, columns, rows] : viewports)
            if (columns > 0 && rows > 0) {
                x0 = std::min(x0, x), x1 = std::max(x1, x + columns);
                y0 = std::min(y0, y), y1 = std::max(y1, y + rows);
            }
        const auto pixels =
            static_cast<std::size_t>(std::max(0, x1 - x0)) * static_cast<std::size_t>(std::max(0, y1 - y0));
        out_.resize((toBytes ? 4 : 16) * pixels / viewports.size());
    }

    // Collective.
    void frame(const PartialImage& image)
    {
        const auto [x, y, columns, rows] = image.viewport;
        for (int row = y; row < y + rows; ++row) {
            const float* from = image.rgba.data() + 4 * image.indexOf(x, row);
            std::uint32_t any = 0;
            for (int i = 0; i < 4 * columns; ++i) {
                std::uint32_t bits = 0;
                std::memcpy(&bits, from + i, sizeof bits);
                any |= bits;
            }
            seen_ = seen_ | any;
        }
        if (!out_.empty())
            std::memset(out_.data(), static_cast<int>(seen_ & 0xff), out_.size());
        MPI_Request request = MPI_REQUEST_NULL;
        MPI_Ibarrier(comm_, &request);
        complete(request);
    }

private:
    MPI_Comm comm_;
    std::vector<std::byte> out_; // this rank's share
    std::uint32_t seen_ = 0;
};

} // namespace bench
