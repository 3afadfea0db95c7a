// PlainCompositor: the common part of compositors as one would write them without a library. Each rank ends up with
// some rows of the image, blended in order in plain float (A += (1 - A) a), which rank 0 gathers. No two steps run at
// the same time, and no empty pixels are left out except those outside the ranks' viewports.
#pragma once

#include "baselines.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <utility>
#include <vector>

namespace bench {

class PlainCompositor {
public:
    PlainCompositor(const PlainCompositor&) = delete;
    PlainCompositor& operator=(const PlainCompositor&) = delete;
    virtual ~PlainCompositor() = default;

    // Collective. `rgba`: this rank's image, of the full size. On rank 0 returns the image, as floats or bytes.
    const std::byte* composite(const std::vector<float>& rgba)
    {
        sent_ = messages_ = 0;
        blendSlice(rgba);
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

protected:
    using Rows = std::array<int, 2>; // the first, and the one after the last
    using Part = std::array<int, 4>; // x, y, width, height; there is nothing in it if the height is not above 0

    // `slices`: the rows that each rank ends up with.
    PlainCompositor(MPI_Comm comm, std::vector<Rows> slices, int width, int height, bool toBytes)
        : comm_(comm), slices_(std::move(slices)), width_(width), toBytes_(toBytes), out_(slices_.size()),
          in_(slices_.size())
    {
        MPI_Comm_rank(comm, &rank_);
        sum_.resize(4 * pixelsOf(slice(rank_)));
        bytes_.resize(toBytes ? sum_.size() : 0);
        if (rank_ == 0)
            image_.resize((toBytes ? 4 : 16) * static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
    }

    int rank() const { return rank_; }
    int size() const { return static_cast<int>(slices_.size()); }
    int width() const { return width_; }
    const Rows& slice(int rank) const { return slices_[static_cast<std::size_t>(rank)]; }
    std::size_t pixelsOf(const Rows& rows) const
    {
        return static_cast<std::size_t>(rows[1] - rows[0]) * static_cast<std::size_t>(width_);
    }
    std::vector<float>& sum() { return sum_; } // of this rank's slice
    // Parts that go to other ranks, and that come from them, by rank. They are kept from frame to frame, because
    // touching new memory takes as long as all the rest.
    std::vector<float>& out(int i) { return out_[static_cast<std::size_t>(i)]; }
    std::vector<float>& in(int i) { return in_[static_cast<std::size_t>(i)]; }

    // The part of a viewport that is in these rows.
    static Part overlap(const Part& viewport, const Rows& rows)
    {
        const int y0 = std::max(viewport[1], rows[0]), y1 = std::min(viewport[1] + viewport[3], rows[1]);
        return {viewport[0], y0, viewport[2], viewport[2] > 0 ? y1 - y0 : 0};
    }

    // Copies a part out of rows that begin with `firstRow`.
    void pack(const std::vector<float>& rows, int firstRow, const Part& part, std::vector<float>& to) const
    {
        const std::size_t row = 4 * static_cast<std::size_t>(part[2]);
        to.resize(row * static_cast<std::size_t>(part[3]));
        for (int y = 0; y < part[3]; ++y)
            std::memcpy(to.data() + row * static_cast<std::size_t>(y), rows.data() + placeOf(part, y - firstRow),
                        row * sizeof(float));
    }

    // Blends what pack() made behind such rows.
    void blend(const std::vector<float>& from, const Part& part, int firstRow, std::vector<float>& rows) const
    {
        const float* c = from.data();
        for (int y = 0; y < part[3]; ++y, c += 4 * static_cast<std::ptrdiff_t>(part[2]))
            blendRow(c, rows.data() + placeOf(part, y - firstRow), part[2]);
    }

    void send(const std::vector<float>& part, int to, int tag, std::vector<MPI_Request>& requests)
    {
        requests.emplace_back();
        MPI_Isend(part.data(), static_cast<int>(part.size()), MPI_FLOAT, to, tag, comm_, &requests.back());
        count(4 * part.size());
    }
    void receive(const Part& part, int from, int tag, std::vector<float>& to, std::vector<MPI_Request>& requests) const
    {
        to.resize(4 * static_cast<std::size_t>(part[2]) * static_cast<std::size_t>(part[3]));
        requests.emplace_back();
        MPI_Irecv(to.data(), static_cast<int>(to.size()), MPI_FLOAT, from, tag, comm_, &requests.back());
    }
    static void waitAll(std::vector<MPI_Request>& requests)
    {
        for (MPI_Request& request : requests)
            complete(request);
    }

private:
    // Collective: makes the sum of this rank's slice.
    virtual void blendSlice(const std::vector<float>& rgba) = 0;

    // The index of a part's row, in floats.
    std::size_t placeOf(const Part& part, int row) const
    {
        return 4
               * (static_cast<std::size_t>(part[1] + row) * static_cast<std::size_t>(width_)
                  + static_cast<std::size_t>(part[0]));
    }

    void gather()
    {
        const std::size_t pixelBytes = toBytes_ ? 4 : 16;
        const std::byte* mine = reinterpret_cast<const std::byte*>(sum_.data());
        if (toBytes_) {
            convertToBytes(sum_.data(), sum_.size(), bytes_.data());
            mine = reinterpret_cast<const std::byte*>(bytes_.data());
        }
        const auto bytesOf = [&](int rank) { return pixelBytes * pixelsOf(slice(rank)); };
        const auto placeOfSlice = [&](int rank) { return image_.data() + pixelBytes * pixelsOf({0, slice(rank)[0]}); };
        constexpr int tag = 0;
        std::vector<MPI_Request> requests;
        if (rank_ != 0) {
            requests.emplace_back();
            MPI_Isend(mine, static_cast<int>(bytesOf(rank_)), MPI_BYTE, 0, tag, comm_, &requests.back());
            count(bytesOf(rank_));
        } else {
            for (int other = 1; other < size(); ++other) {
                requests.emplace_back();
                MPI_Irecv(placeOfSlice(other), static_cast<int>(bytesOf(other)), MPI_BYTE, other, tag, comm_,
                          &requests.back());
            }
            std::memcpy(placeOfSlice(0), mine, bytesOf(0));
        }
        waitAll(requests);
    }

    void count(std::size_t bytes)
    {
        sent_ += static_cast<std::int64_t>(bytes);
        ++messages_;
    }

    MPI_Comm comm_;
    std::vector<Rows> slices_;
    int width_, rank_ = 0;
    bool toBytes_;
    std::vector<std::vector<float>> out_, in_;
    std::vector<float> sum_;
    std::vector<std::uint8_t> bytes_;
    std::vector<std::byte> image_;
    std::int64_t sent_ = 0, messages_ = 0;
};

} // namespace bench
