// VoxelBlock: the part of a volume that a brick holds in memory.
#pragma once

#include "volume.hpp"

namespace example {

// The voxels [lo, hi) of a volume. The box may reach beyond the volume by the ghosts that gradients need; there the
// nearest voxel is repeated, so that sampling needs no clamping.
class VoxelBlock {
public:
    VoxelBlock(const VolumeSource& source, const Index3& lo, const Index3& hi)
        : info_(source.info), lo_(lo), nx_(static_cast<std::size_t>(hi[0] - lo[0])),
          nxy_(nx_ * static_cast<std::size_t>(hi[1] - lo[1])), hi_(hi)
    {
        const std::size_t size = voxelBytes(info_.type);
        bytes_.resize(nxy_ * static_cast<std::size_t>(hi[2] - lo[2]) * size);
        const RowReader read = source.open();
        const int x0 = std::max(lo[0], 0), x1 = std::min(hi[0], info_.dims[0]);
        const std::size_t rowBytes = nx_ * size;
        // Calls f(y, z, the row in the block) for the rows whose voxels are in the volume, or for the others.
        const auto forRows = [&](bool areInside, const auto& f) {
            for (int z = lo[2]; z < hi[2]; ++z)
                for (int y = lo[1]; y < hi[1]; ++y)
                    if (areInside == (y >= 0 && y < info_.dims[1] && z >= 0 && z < info_.dims[2]))
                        f(y, z, bytes_.data() + index(lo[0], y, z) * size);
        };
        const auto readRow = [&](int y, int z, std::byte* row) {
            std::byte* inside = row + static_cast<std::size_t>(x0 - lo[0]) * size;
            read(x0, x1, y, z, inside);
            for (int x = lo[0]; x < x0; ++x)
                std::memcpy(row + static_cast<std::size_t>(x - lo[0]) * size, inside, size);
            for (int x = x1; x < hi[0]; ++x)
                std::memcpy(row + static_cast<std::size_t>(x - lo[0]) * size,
                            inside + static_cast<std::size_t>(x1 - 1 - x0) * size, size);
        };
        forRows(true, readRow);
        forRows(false, [&](int y, int z, std::byte* row) {
            const int nearY = std::clamp(y, 0, info_.dims[1] - 1), nearZ = std::clamp(z, 0, info_.dims[2] - 1);
            if (nearY >= lo[1] && nearY < hi[1] && nearZ >= lo[2] && nearZ < hi[2])
                std::memcpy(row, bytes_.data() + index(lo[0], nearY, nearZ) * size, rowBytes);
            else
                readRow(nearY, nearZ, row);
        });
    }

    const VolumeInfo& info() const { return info_; }
    const Index3& lo() const { return lo_; }
    const Index3& hi() const { return hi_; }
    std::size_t rowStride() const { return nx_; }
    std::size_t sliceStride() const { return nxy_; }

    // Of a voxel by its index in the whole volume.
    std::size_t index(int x, int y, int z) const
    {
        return static_cast<std::size_t>(z - lo_[2]) * nxy_ + static_cast<std::size_t>(y - lo_[1]) * nx_
               + static_cast<std::size_t>(x - lo_[0]);
    }
    template <class T>
    const T* data() const
    {
        return reinterpret_cast<const T*>(bytes_.data());
    }

private:
    VolumeInfo info_;
    Index3 lo_;
    std::size_t nx_, nxy_;
    Index3 hi_;
    std::vector<std::byte> bytes_;
};

} // namespace example
