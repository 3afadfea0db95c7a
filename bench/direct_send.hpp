// DirectSend: what one would write without a library: each rank owns a slice of the image, gets the parts of it that
// others have, blends them in order in plain float (A += (1 - A) a), and rank 0 gathers the slices. Nothing overlaps
// with anything, no empty pixel is left out but those outside the ranks' viewports.
#pragma once

#include "baselines.hpp"
#include "brick_images.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace bench {

class DirectSend {
public:
    // `order`: the ranks front to back. `viewports`: of each rank.
    DirectSend(MPI_Comm comm, std::vector<int> order, std::vector<std::array<int, 4>> viewports, int width, int height,
               bool toBytes)
        : comm_(comm), order_(std::move(order)), viewports_(std::move(viewports)), width_(width), height_(height),
          toBytes_(toBytes)
    {
        MPI_Comm_rank(comm, &rank_);
        const std::size_t pixels = pixelsOf(slice(rank_));
        sum_.resize(4 * pixels);
        bytes_.resize(toBytes ? 4 * pixels : 0);
        if (rank_ == 0)
            image_.resize((toBytes ? 4 : 16) * static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
    }

    // Collective. On rank 0 the image: floats, or bytes.
    const std::byte* composite(const std::vector<float>& rgba)
    {
        sent_ = messages_ = 0;
        const int size = static_cast<int>(order_.size());
        std::vector<MPI_Request> sends, receives;
        std::vector<std::vector<float>> out(static_cast<std::size_t>(size)), in(static_cast<std::size_t>(size));
        for (int other = 0; other < size; ++other) {
            const auto there = overlap(other, rank_);
            if (other == rank_ || there[3] <= 0)
                continue;
            auto& buffer = in[static_cast<std::size_t>(other)];
            buffer.resize(4 * static_cast<std::size_t>(there[2]) * static_cast<std::size_t>(there[3]));
            receives.emplace_back();
            MPI_Irecv(buffer.data(), static_cast<int>(buffer.size()), MPI_FLOAT, other, 1, comm_, &receives.back());
        }
        for (int step = 1; step < size; ++step) {
            const int other = (rank_ + step) % size;
            const auto mine = overlap(rank_, other);
            if (mine[3] <= 0)
                continue;
            auto& buffer = out[static_cast<std::size_t>(other)];
            pack(rgba, mine, buffer);
            sends.emplace_back();
            MPI_Isend(buffer.data(), static_cast<int>(buffer.size()), MPI_FLOAT, other, 1, comm_, &sends.back());
            count(4 * buffer.size());
        }
        if (const auto own = overlap(rank_, rank_); own[3] > 0)
            pack(rgba, own, in[static_cast<std::size_t>(rank_)]);
        waitAll(receives);
        std::fill(sum_.begin(), sum_.end(), 0.0f);
        for (const int other : order_)
            if (const auto there = overlap(other, rank_); there[3] > 0)
                blend(in[static_cast<std::size_t>(other)], there);
        waitAll(sends);
        gather();
        return image_.data();
    }

    std::int64_t bytesSent() const { return sent_; }
    std::int64_t messagesSent() const { return messages_; }

    // Blends a layer behind a row; null: begins a row.
    static void blendRow(const float* layer, float* acc, int count)
    {
        if (!layer) {
            std::fill_n(acc, 4 * count, 0.0f);
            return;
        }
        for (int x = 0; x < count; ++x, acc += 4, layer += 4) {
            const float t = 1 - acc[3];
            for (int k = 0; k < 4; ++k)
                acc[k] += t * layer[k];
        }
    }
    static void convertToBytes(const float* from, std::size_t count, std::uint8_t* to)
    {
        for (std::size_t i = 0; i < count; ++i)
            to[i] = static_cast<std::uint8_t>(std::min(std::max(from[i], 0.0f), 1.0f) * 255 + 0.5f);
    }

private:
    // First row, and the one after the last.
    std::array<int, 2> slice(int rank) const
    {
        const int size = static_cast<int>(order_.size());
        return {height_ * rank / size, height_ * (rank + 1) / size};
    }
    std::size_t pixelsOf(const std::array<int, 2>& rows) const
    {
        return static_cast<std::size_t>(rows[1] - rows[0]) * static_cast<std::size_t>(width_);
    }
    // What `from` has in the slice of `owner`: x, y, width, height.
    std::array<int, 4> overlap(int from, int owner) const
    {
        const auto& v = viewports_[static_cast<std::size_t>(from)];
        const auto rows = slice(owner);
        const int y0 = std::max(v[1], rows[0]), y1 = std::min(v[1] + v[3], rows[1]);
        return {v[0], y0, v[2], v[2] > 0 ? y1 - y0 : 0};
    }

    void pack(const std::vector<float>& rgba, const std::array<int, 4>& part, std::vector<float>& to) const
    {
        const std::size_t row = 4 * static_cast<std::size_t>(part[2]);
        to.resize(row * static_cast<std::size_t>(part[3]));
        for (int y = 0; y < part[3]; ++y)
            std::memcpy(to.data() + row * static_cast<std::size_t>(y),
                        rgba.data()
                            + 4
                                  * (static_cast<std::size_t>(part[1] + y) * static_cast<std::size_t>(width_)
                                     + static_cast<std::size_t>(part[0])),
                        row * sizeof(float));
    }

    void blend(const std::vector<float>& from, const std::array<int, 4>& part)
    {
        const float* c = from.data();
        for (int y = 0; y < part[3]; ++y) {
            float* acc =
                sum_.data()
                + 4
                      * (static_cast<std::size_t>(part[1] + y - slice(rank_)[0]) * static_cast<std::size_t>(width_)
                         + static_cast<std::size_t>(part[0]));
            blendRow(c, acc, part[2]);
            c += 4 * static_cast<std::ptrdiff_t>(part[2]);
        }
    }

    void gather()
    {
        const std::size_t pixelBytes = toBytes_ ? 4 : 16;
        const std::byte* mine = reinterpret_cast<const std::byte*>(sum_.data());
        if (toBytes_) {
            convertToBytes(sum_.data(), sum_.size(), bytes_.data());
            mine = reinterpret_cast<const std::byte*>(bytes_.data());
        }
        const auto placeOf = [&](int rank) {
            return pixelBytes * static_cast<std::size_t>(width_) * static_cast<std::size_t>(slice(rank)[0]);
        };
        const auto bytesOf = [&](int rank) { return pixelBytes * pixelsOf(slice(rank)); };
        std::vector<MPI_Request> requests;
        if (rank_ != 0) {
            requests.emplace_back();
            MPI_Isend(mine, static_cast<int>(bytesOf(rank_)), MPI_BYTE, 0, 2, comm_, &requests.back());
            count(bytesOf(rank_));
        } else {
            for (int other = 1; other < static_cast<int>(order_.size()); ++other) {
                requests.emplace_back();
                MPI_Irecv(image_.data() + placeOf(other), static_cast<int>(bytesOf(other)), MPI_BYTE, other, 2, comm_,
                          &requests.back());
            }
            std::memcpy(image_.data(), mine, bytesOf(0));
        }
        waitAll(requests);
    }

    static void waitAll(std::vector<MPI_Request>& requests)
    {
        for (MPI_Request& request : requests)
            complete(request, Waiting::Yield);
    }
    void count(std::size_t bytes)
    {
        sent_ += static_cast<std::int64_t>(bytes);
        ++messages_;
    }

    MPI_Comm comm_;
    std::vector<int> order_;
    std::vector<std::array<int, 4>> viewports_;
    int width_, height_, rank_ = 0;
    bool toBytes_;
    std::vector<float> sum_;
    std::vector<std::uint8_t> bytes_;
    std::vector<std::byte> image_;
    std::int64_t sent_ = 0, messages_ = 0;
};

} // namespace bench
