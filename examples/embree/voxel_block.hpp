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
        // Reads the voxels of the volume that are in the block, or nearest to it, in slabs of some MB.
        Index3 first, behind;
        for (std::size_t axis = 0; axis < 3; ++axis) {
            first[axis] = std::clamp(lo[axis], 0, info_.dims[axis] - 1);
            behind[axis] = std::clamp(hi[axis] - 1, 0, info_.dims[axis] - 1) + 1;
        }
        const std::size_t rowVoxels = static_cast<std::size_t>(behind[0] - first[0]),
                          layerVoxels = rowVoxels * static_cast<std::size_t>(behind[1] - first[1]);
        const int layers = static_cast<int>(std::max<std::size_t>(1, (std::size_t{4} << 20) / (layerVoxels * size)));
        std::vector<std::byte> slab;
        const BoxReader read = source.open();
        int slabZ = first[2], slabEnd = slabZ; // of what is in the slab
        for (int z = lo[2]; z < hi[2]; ++z) {
            const int nearZ = std::clamp(z, first[2], behind[2] - 1);
            if (nearZ >= slabEnd) {
                slabZ = slabEnd;
                slabEnd = std::min(slabZ + layers, behind[2]);
                slab.resize(layerVoxels * static_cast<std::size_t>(slabEnd - slabZ) * size);
                read({first[0], first[1], slabZ}, {behind[0], behind[1], slabEnd}, slab.data());
            }
            for (int y = lo[1]; y < hi[1]; ++y) {
                const auto nearY = static_cast<std::size_t>(std::clamp(y, first[1], behind[1] - 1) - first[1]);
                const std::byte* from =
                    slab.data() + (static_cast<std::size_t>(nearZ - slabZ) * layerVoxels + nearY * rowVoxels) * size;
                std::byte* to = bytes_.data() + index(lo[0], y, z) * size;
                for (int x = lo[0]; x < first[0]; ++x, to += size)
                    std::memcpy(to, from, size);
                std::memcpy(to, from, rowVoxels * size);
                to += rowVoxels * size;
                for (int x = behind[0]; x < hi[0]; ++x, to += size)
                    std::memcpy(to, from + (rowVoxels - 1) * size, size);
            }
        }
    }

    const VolumeInfo& info() const { return info_; }
    const Index3& lo() const { return lo_; }
    const Index3& hi() const { return hi_; }
    std::size_t rowStride() const { return nx_; }
    std::size_t sliceStride() const { return nxy_; }

    // The index of a voxel in the block, from its index in the whole volume.
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
