// Collective: an object of the library that has an image. Its construction, calls and destruction are collective.
#pragma once

#include "errors.hpp"
#include "ranks.hpp"
#include "settings.hpp"
#include "views.hpp"

#include <dfb/frame.hpp>
#include <dfb/image.hpp>

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include <unistd.h>

namespace dfb_python {

// `Object`: dfb::ImageCompositor, or a class with the same members. Members are called with the GIL, and release it
// while they wait.
template <class Object>
class Collective {
public:
    // `make(connection)` returns the object. Collective.
    template <class Make>
    Collective(const py::object& comm, const Settings& settings, const Make& make) : frame_(settings.frame)
    {
        auto connection = connect(comm);
        views_.emplace(connection->pool());
        {
            const py::gil_scoped_release released;
            object_.reset(make(std::move(connection)).release());
        }
        const auto& image = object_->config().image;
        rank_ = object_->rank(), size_ = object_->size(), displayRank_ = image.displayRank;
        width_ = image.width, height_ = image.height;
    }
    Collective(const Collective&) = delete;
    Collective& operator=(const Collective&) = delete;

    // These may be read while another thread is in a call, and from what such a call calls.
    int rank() const { return open(rank_); }
    int size() const { return open(size_); }
    int width() const { return open(width_); }
    int height() const { return open(height_); }
    int displayRank() const { return open(displayRank_); }
    bool isClosed() const { return !object_; }

    // The last picture on the display rank, else None.
    py::object image() { return Use(*this).views().color(object().image()); }
    py::object depth() { return Use(*this).views().depth(object().image()); }

    py::tuple imageOnAllRanks()
    {
        const Use use(*this);
        return ownArrays(withoutGil(*Cause::make(), [&] { return object_->imageOnAllRanks(); }));
    }

    // Throws BufferError on a rank that has arrays of the image, and dfb.Error on the others.
    void resize(const py::object& width, const py::object& height)
    {
        const Use use(*this);
        const bool hasArrays = views_->any();
        std::array<int, 2> to{};
        std::string why; // this rank refuses
        if (hasArrays)
            why = "there are arrays of the image, so it cannot get another size: delete them, or take copies";
        else if (!toIntegers(py::make_tuple(width, height), to))
            why = "the new size is " + shown(width) + " x " + shown(height) + ": it must be two ints of 32 bits";
        try {
            withoutGil(*Cause::make(), [&] {
                refuseTogether(why, "resize()");
                object_->resize(to[0], to[1]);
            });
        } catch (py::error_already_set& error) {
            if (!hasArrays)
                throw;
            py::raise_from(error, PyExc_BufferError, why.c_str());
            throw py::error_already_set();
        }
        width_ = to[0], height_ = to[1];
    }

    // Arrays of the image stay valid.
    void close()
    {
        if (!object_)
            return;
        const Use use(*this);
        views_.reset();
        auto ended = std::move(object_);
        const py::gil_scoped_release released;
        ended.reset();
    }

    // Replaces close() on a rank that leaves because of an exception, when the others may never reach their close().
    // They get an error of the kind Transport. Waits for nobody.
    void leave()
    {
        if (!object_)
            return;
        const Use use(*this);
        views_.reset();
        struct Left {};
        auto left = std::move(object_);
        const py::gil_scoped_release released;
        try {
            const auto ended = std::move(left); // its connection checks whether there is an exception
            throw Left();
        } catch (const Left&) {
        }
    }

protected:
    // A call of the object, which takes one call at a time. Throws InvalidArgument if it cannot take one now.
    class Use {
    public:
        explicit Use(Collective& owner) : owner_(owner)
        {
            owner.object();
            if (owner.isInUse_)
                throw dfb::InvalidArgument("another call of this object has not returned yet");
            owner.isInUse_ = true;
        }
        Use(const Use&) = delete;
        Use& operator=(const Use&) = delete;
        ~Use() { owner_.isInUse_ = false; }

        const ImageViews& views() const { return *owner_.views_; }

    private:
        Collective& owner_;
    };

    Object& object() const
    {
        if (!object_)
            throw dfb::InvalidArgument("this object is closed");
        return *object_;
    }
    const dfb::FrameConfig& frame() const noexcept { return frame_; }

    // Collective. Throws InvalidArgument on all ranks, with the reason of the lowest rank that has one, if `why` is not
    // empty everywhere. `call`: see dfb::ImageCompositor::allGather().
    void refuseTogether(const std::string& why, const char* call)
    {
        const auto* bytes = reinterpret_cast<const std::byte*>(why.data());
        const auto reasons = object_->allGather({bytes, bytes + why.size()}, call);
        const auto first = std::find_if(reasons.begin(), reasons.end(), [](const auto& r) { return !r.empty(); });
        if (first == reasons.end())
            return;
        try {
            object_->allGather({}, call); // no rank may leave before all know the reason
        } catch (const dfb::TransportError&) {
            // A rank has left already, so all know it.
        }
        dfb::ErrorInfo info;
        info.rank = static_cast<int>(first - reasons.begin());
        info.message.assign(reinterpret_cast<const char*>(first->data()), first->size());
        throw dfb::InvalidArgument(std::move(info));
    }

private:
    int open(int value) const
    {
        object();
        return value;
    }

    // Leaves the object alone in a process that was forked off: it has none of the threads that the end waits for.
    struct EndInMaker {
        pid_t maker = ::getpid();

        void operator()(Object* object) const
        {
            if (::getpid() == maker)
                delete object;
        }
    };

    dfb::FrameConfig frame_;
    std::unique_ptr<Object, EndInMaker> object_;
    std::optional<ImageViews> views_;
    bool isInUse_ = false;
    int rank_ = 0, size_ = 1, displayRank_ = 0, width_ = 0, height_ = 0; // calls may replace the object's own
};

} // namespace dfb_python
