// HDF5: volumes that are data sets of HDF5 files, as simulations write them. Each rank reads its part as hyperslabs.
#pragma once

#include "hdf5_path.hpp"
#include "volume.hpp"

#include <string>

#if defined(DFB_RENDER_HAS_HDF5)
#include <hdf5.h>

#include <memory>
#include <mutex>
#include <vector>
#endif

namespace example {

#if defined(DFB_RENDER_HAS_HDF5)

namespace detail {

// Ranks may be threads, and not every build of HDF5 is thread-safe.
inline std::mutex& hdf5Mutex()
{
    static std::mutex mutex;
    return mutex;
}

// An object of the HDF5 library. Its members must be called with the mutex held.
class Hdf5Object {
public:
    Hdf5Object() = default;
    Hdf5Object(hid_t id, herr_t (*close)(hid_t)) : id_(id), close_(close) {}
    Hdf5Object(Hdf5Object&& other) noexcept : id_(std::exchange(other.id_, -1)), close_(other.close_) {}
    Hdf5Object& operator=(Hdf5Object&& other) noexcept
    {
        std::swap(id_, other.id_);
        std::swap(close_, other.close_);
        return *this;
    }
    ~Hdf5Object()
    {
        if (id_ >= 0)
            close_(id_);
    }

    bool isThere() const { return id_ >= 0; }
    hid_t id() const { return id_; }

private:
    hid_t id_ = -1;
    herr_t (*close_)(hid_t) = nullptr;
};

// An open data set with three axes of more than one value, of which the last one is x.
class Hdf5Volume {
public:
    // Throws std::runtime_error with the path.
    explicit Hdf5Volume(const std::string& path) : path_(path)
    {
        const std::lock_guard<std::mutex> lock(hdf5Mutex());
        try {
            open();
        } catch (...) { // with the mutex held
            close();
            throw;
        }
    }
    ~Hdf5Volume()
    {
        const std::lock_guard<std::mutex> lock(hdf5Mutex());
        close();
    }
    Hdf5Volume(const Hdf5Volume&) = delete;
    Hdf5Volume& operator=(const Hdf5Volume&) = delete;

    const Index3& dims() const { return dims_; }
    VoxelType type() const { return type_; }
    bool isFloat() const { return isFloat_; }
    std::size_t fileBytes() const { return fileBytes_; } // of a voxel

    // Reads the voxels [lo, hi) in memory's type, x fastest. Throws std::runtime_error.
    void read(const Index3& lo, const Index3& hi, std::byte* out) const
    {
        const std::lock_guard<std::mutex> lock(hdf5Mutex());
        std::vector<hsize_t> start(extent_.size(), 0), size(extent_.size(), 1);
        for (std::size_t axis = 0; axis < 3; ++axis) {
            start[axes_[axis]] = static_cast<hsize_t>(lo[axis]);
            size[axes_[axis]] = static_cast<hsize_t>(hi[axis] - lo[axis]);
        }
        // Both have the same shape; otherwise the library copies chunked data voxel by voxel.
        const Hdf5Object in(H5Scopy(space_.id()), H5Sclose),
            memory(H5Screate_simple(static_cast<int>(size.size()), size.data(), nullptr), H5Sclose);
        const hid_t type = type_ == VoxelType::UInt8    ? H5T_NATIVE_UINT8
                           : type_ == VoxelType::UInt16 ? H5T_NATIVE_UINT16
                           : type_ == VoxelType::Int16  ? H5T_NATIVE_INT16
                                                        : H5T_NATIVE_FLOAT;
        if (H5Sselect_hyperslab(in.id(), H5S_SELECT_SET, start.data(), nullptr, size.data(), nullptr) < 0
            || H5Dread(data_.id(), type, memory.id(), in.id(), H5P_DEFAULT, out) < 0)
            fail("reading failed at y=" + std::to_string(lo[1]) + " z=" + std::to_string(lo[2]) + missingFilter());
    }

private:
    [[noreturn]] void fail(const std::string& why) const { throw std::runtime_error(path_ + ": " + why); }

    void open()
    {
        H5Eset_auto2(H5E_DEFAULT, nullptr, nullptr); // otherwise the library prints the errors that are thrown here
        const auto [file, name] = splitHdf5Path(path_);
        file_ = Hdf5Object(H5Fopen(file.c_str(), H5F_ACC_RDONLY, H5P_DEFAULT), H5Fclose);
        if (!file_.isThere())
            fail("cannot be opened as an HDF5 file");
        const Hdf5Object access(H5Pcreate(H5P_DATASET_ACCESS), H5Pclose);
        // Room for the chunks of about one layer, because slabs of some layers are read one after the other.
        H5Pset_chunk_cache(access.id(), 12421, std::size_t{64} << 20, 1.0);
        data_ = Hdf5Object(H5Dopen2(file_.id(), name.c_str(), access.id()), H5Dclose);
        if (!data_.isThere())
            fail("expected a data set, as in file.h5:/path; there are" + list());
        space_ = Hdf5Object(H5Dget_space(data_.id()), H5Sclose);
        readExtent();
        readType();
    }

    // "", or which filter of the data set this HDF5 library lacks.
    std::string missingFilter() const
    {
        const Hdf5Object creation(H5Dget_create_plist(data_.id()), H5Pclose);
        for (int i = 0; i < H5Pget_nfilters(creation.id()); ++i) {
            unsigned flags = 0, config = 0;
            std::size_t values = 0;
            char name[64] = "";
            const H5Z_filter_t filter = H5Pget_filter2(creation.id(), static_cast<unsigned>(i), &flags, &values,
                                                       nullptr, sizeof name, name, &config);
            if (H5Zfilter_avail(filter) <= 0)
                return std::string(": this HDF5 library lacks the filter ") + name + " (" + std::to_string(filter)
                       + "); HDF5_PLUGIN_PATH may say where it is";
        }
        return "";
    }

    void close()
    {
        space_ = Hdf5Object();
        data_ = Hdf5Object();
        file_ = Hdf5Object();
        H5Eclear2(H5E_DEFAULT); // otherwise the library may print the errors of this thread when the program ends
    }

    // The names of the first data sets in the file, as a text.
    std::string list() const
    {
        std::vector<std::string> names;
        const auto visit = [](hid_t group, const char* name, const H5L_info_t*, void* data) -> herr_t {
            auto& all = *static_cast<std::vector<std::string>*>(data);
            const Hdf5Object object(H5Oopen(group, name, H5P_DEFAULT), H5Oclose);
            if (object.isThere() && H5Iget_type(object.id()) == H5I_DATASET)
                all.push_back(name);
            return all.size() > 6;
        };
        H5Lvisit(file_.id(), H5_INDEX_NAME, H5_ITER_INC, visit, &names);
        std::string text;
        for (std::size_t i = 0; i < names.size() && i < 6; ++i)
            text += (i == 0 ? " /" : ", /") + names[i];
        return names.empty() ? " none" : text + (names.size() > 6 ? " and more" : "");
    }

    void readExtent()
    {
        const int rank = H5Sget_simple_extent_ndims(space_.id());
        extent_.resize(static_cast<std::size_t>(std::max(0, rank)));
        if (rank > 0)
            H5Sget_simple_extent_dims(space_.id(), extent_.data(), nullptr);
        std::string text;
        std::vector<std::size_t> longAxes;
        for (std::size_t axis = 0; axis < extent_.size(); ++axis) {
            text += (axis == 0 ? "" : "x") + std::to_string(extent_[axis]);
            if (extent_[axis] != 1)
                longAxes.push_back(axis);
        }
        bool isRight = longAxes.size() == 3;
        for (const std::size_t axis : longAxes)
            isRight = isRight && extent_[axis] >= 2 && extent_[axis] <= 65536;
        if (!isRight)
            fail("expected a data set with three axes of 2 to 65536 values, got " + (text.empty() ? "none" : text));
        for (std::size_t axis = 0; axis < 3; ++axis) {
            axes_[axis] = longAxes[2 - axis]; // the last one is the fastest
            dims_[axis] = static_cast<int>(extent_[axes_[axis]]);
        }
    }

    void readType()
    {
        const Hdf5Object type(H5Dget_type(data_.id()), H5Tclose);
        const H5T_class_t kind = H5Tget_class(type.id());
        fileBytes_ = H5Tget_size(type.id());
        if (kind != H5T_INTEGER && kind != H5T_FLOAT)
            fail("expected a data set of integers or floats");
        isFloat_ = kind == H5T_FLOAT;
        const bool hasSign = !isFloat_ && H5Tget_sign(type.id()) == H5T_SGN_2;
        type_ = isFloat_ || fileBytes_ > 2 ? VoxelType::Float32
                : hasSign                  ? VoxelType::Int16
                : fileBytes_ == 1          ? VoxelType::UInt8
                                           : VoxelType::UInt16;
    }

    std::string path_;
    Hdf5Object file_, data_, space_;
    std::vector<hsize_t> extent_;
    std::array<std::size_t, 3> axes_{}; // axes of the data set that are x, y and z
    Index3 dims_{};
    VoxelType type_ = VoxelType::Float32;
    bool isFloat_ = false;
    std::size_t fileBytes_ = 0;
};

} // namespace detail

// Collective, like openVolume().
inline VolumeSource openHdf5(const std::string& path, const Loaders& loaders = {}, const VoxelGrid& grid = {},
                             const LookOf& lookOf = {})
{
    VolumeInfo info;
    bool isFloat = false;
    BoxReader read;
    const VoxelRange range = VoxelRange::of(loaders.gatherOf<VoxelRange>([&] {
        const auto volume = std::make_shared<detail::Hdf5Volume>(path);
        info.dims = volume->dims();
        info.type = volume->type();
        isFloat = volume->isFloat();
        read = [volume, counter = loaders.readCounter()](const Index3& lo, const Index3& hi, std::byte* out) {
            volume->read(lo, hi, out);
            *counter += voxelsOfBox(lo, hi) * volume->fileBytes();
        };
        if (info.type == VoxelType::UInt8)
            return std::vector<VoxelRange>{{0, 255, 0}};
        return std::vector<VoxelRange>{rangeOfShare(info.dims, info.type, read, loaders)};
    }));
    info.spacing = grid.spacing.value_or(info.spacing);
    info.origin = grid.origin.value_or(info.origin);
    setRange(info, range, isFloat, path);
    if (isFloat)
        read = finiteReader(std::move(read), info.minimum);
    VolumeSource source;
    source.name = path;
    source.info = info;
    source.open = [read] { return read; };
    lookInto(source, loaders, lookOf);
    return source;
}

#else

inline VolumeSource openHdf5(const std::string& path, const Loaders& = {}, const VoxelGrid& = {}, const LookOf& = {})
{
    throw std::runtime_error(path + ": this dfb_render was built without HDF5 (Debian and Ubuntu: libhdf5-dev)");
}

#endif

} // namespace example
