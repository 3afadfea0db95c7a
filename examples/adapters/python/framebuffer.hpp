// FrameBuffer: dfb::DistributedFrameBuffer and its loop over bricks, for Python.
#pragma once

#include "collective.hpp"
#include "operation.hpp"
#include "tiles.hpp"

#include <dfb/distributed_framebuffer.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/cameras.hpp>
#include <dfb/render/loops.hpp>
#include <dfb/render/world.hpp>

#include <array>
#include <cstddef>
#include <exception>
#include <functional>
#include <memory>
#include <new>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

// The operations. If ranks have different ones, the error shows these names.
namespace blend {
class alpha : public dfb::AlphaBlend {};
class nearest : public dfb::DepthComposite {};
class function : public dfb_python::NumpyOperation {};
} // namespace blend

namespace dfb_python {

using AnyCamera = std::variant<dfb::PerspectiveCamera, dfb::MatrixCamera>;
using RenderBrick = std::function<void(const dfb::Brick&, RenderTile&)>;

// A framebuffer with any of the operations. The members are those of dfb::DistributedFrameBuffer.
class AnyFrameBuffer {
public:
    virtual ~AnyFrameBuffer() = default;

    virtual int rank() const = 0;
    virtual int size() const = 0;
    virtual const dfb::FrameBufferConfig& config() const = 0;
    virtual const dfb::Image& image() const = 0;
    virtual dfb::Image imageOnAllRanks() = 0;
    virtual std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& bytes, const char* call) = 0;
    virtual void resize(int width, int height) = 0;
    // Renders a whole frame. `data` is for a NumpyOperation.
    virtual dfb::FrameReport render(const dfb::World& world, const AnyCamera& camera, const RenderBrick& draw,
                                    const dfb::FrameConfig& frame, const NumpyOperation::FrameData& data) = 0;
    // Replaces render() on a rank that cannot take part. Throws on all ranks.
    virtual dfb::FrameReport fail(const std::exception_ptr& why, dfb::FrameConfig frame,
                                  const NumpyOperation::FrameData& data) = 0;

    std::shared_ptr<py::object> function; // the operation, if it is a function of Python
};

template <class TileOp>
class FrameBufferOf final : public AnyFrameBuffer {
    // The connection exists already, so the transport here does not matter.
    using Inner = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, dfb::InprocTransport>;
    static_assert(std::is_same_v<typename Inner::Tile, RenderTile>);

public:
    FrameBufferOf(std::shared_ptr<dfb::Connection>&& connection, const dfb::FrameBufferConfig& config)
        : inner_(std::move(connection), config)
    {
    }

    int rank() const override { return inner_.rank(); }
    int size() const override { return inner_.size(); }
    const dfb::FrameBufferConfig& config() const override { return inner_.config(); }
    const dfb::Image& image() const override { return inner_.image(); }
    dfb::Image imageOnAllRanks() override { return inner_.imageOnAllRanks(); }
    std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& bytes, const char* call) override
    {
        return inner_.allGather(bytes, call);
    }
    void resize(int width, int height) override { inner_.resize(width, height); }

    dfb::FrameReport render(const dfb::World& world, const AnyCamera& camera, const RenderBrick& draw,
                            const dfb::FrameConfig& frame, const NumpyOperation::FrameData& data) override
    {
        std::optional<dfb::DataParallelLoop<Inner>> loop;
        try {
            loop.emplace(inner_, world);
        } catch (const std::bad_alloc&) { // on this rank alone
            return fail(std::current_exception(), frame, data);
        }
        return std::visit([&](const auto& seen) { return loop->render(seen, draw, frame, own(data)); }, camera);
    }

    dfb::FrameReport fail(const std::exception_ptr& why, dfb::FrameConfig frame,
                          const NumpyOperation::FrameData& data) override
    {
        frame.declared = true; // as in the loop of the other ranks
        auto open = inner_.begin(frame, own(data));
        open.abort(why);
        return open.end();
    }

private:
    static typename Inner::TileFrameData own([[maybe_unused]] const NumpyOperation::FrameData& data)
    {
        if constexpr (std::is_same_v<TileOp, blend::function>)
            return data;
        else
            return {};
    }

    Inner inner_;
};

struct FrameBufferSettings : Settings {
    enum class Blend { Alpha, Nearest, Function };
    Blend blend = Blend::Alpha;
    std::shared_ptr<py::object> function;

    explicit FrameBufferSettings(const py::dict& from) : Settings(from)
    {
        attempt([&] {
            const py::object given = from["blend"];
            if (PyCallable_Check(given.ptr())) {
                blend = Blend::Function;
                function.reset(new py::object(given), [](py::object* kept) {
                    const py::gil_scoped_acquire gil;
                    delete kept;
                });
                return;
            }
            const auto name = argument<std::string>(from, "blend", "'alpha', 'nearest' or a function");
            if (name == "nearest")
                blend = Blend::Nearest;
            else if (name != "alpha")
                throw dfb::InvalidArgument("blend is '" + name + "': it must be 'alpha', 'nearest' or a function");
        });
    }

    std::unique_ptr<AnyFrameBuffer> make(std::shared_ptr<dfb::Connection>&& connection) const
    {
        auto made = makeWith(std::move(connection));
        made->function = function;
        return made;
    }

private:
    std::unique_ptr<AnyFrameBuffer> makeWith(std::shared_ptr<dfb::Connection>&& connection) const
    {
        switch (blend) {
        case Blend::Nearest: return std::make_unique<FrameBufferOf<blend::nearest>>(std::move(connection), config);
        case Blend::Function: return std::make_unique<FrameBufferOf<blend::function>>(std::move(connection), config);
        case Blend::Alpha: break;
        }
        return std::make_unique<FrameBufferOf<blend::alpha>>(std::move(connection), config);
    }
};

class FrameBuffer : public Collective<AnyFrameBuffer> {
public:
    FrameBuffer(const py::object& comm, const FrameBufferSettings& settings)
        : Collective(comm, settings, [&](std::shared_ptr<dfb::Connection>&& connection) {
              return settings.make(std::move(connection));
          })
    {
    }

    // Calls draw(brick, tile) for each brick and each tile that it may cover, on several threads in turn. An error on
    // one rank is raised on all.
    dfb::FrameReport render(const py::object& bricks, const py::object& camera, const py::object& draw)
    {
        const Use use(*this);
        const auto cause = Cause::make();
        std::vector<py::object> objects;
        dfb::World world;
        std::optional<AnyCamera> seen;
        const std::exception_ptr wrong = caught(*cause, [&] {
            if (!py::isinstance<py::iterable>(bricks))
                throw dfb::InvalidArgument("bricks is a " + typeOf(bricks) + ": it must be a list of bricks");
            for (const py::handle brick : bricks) {
                world.add(brickOf(brick));
                objects.push_back(py::reinterpret_borrow<py::object>(brick));
            }
            seen = cameraOf(camera);
            if (!PyCallable_Check(draw.ptr()))
                throw dfb::InvalidArgument("the renderer is " + shown(draw) + ": it must be a function");
        });
        const NumpyOperation::FrameData data{object().function, cause};
        const auto& picture = object().config().image;
        const RenderBrick render = [&](const dfb::Brick& brick, RenderTile& tile) {
            inTurn(*cause, [&] {
                const py::object given = py::cast(PythonTile(tile, picture.width, picture.height));
                const py::object returned =
                    draw(objects[static_cast<std::size_t>(&brick - world.bricks().data())], given);
                if (!returned.is_none())
                    throw dfb::InvalidArgument("the renderer returned a " + typeOf(returned)
                                               + ": it fills tile.rgba and tile.depth, and returns None");
                given.cast<const PythonTile&>().copyTo(tile);
            });
        };
        return withoutGil(*cause, [&] {
            return wrong ? object().fail(wrong, frame(), data) : object().render(world, *seen, render, frame(), data);
        });
    }

    // Replaces render() on a rank that cannot take part; throws on all ranks.
    void fail(const std::string& why)
    {
        const Use use(*this);
        const auto cause = Cause::make();
        withoutGil(*cause, [&] {
            object().fail(std::make_exception_ptr(std::runtime_error(why)), frame(), {object().function, cause});
        });
    }

private:
    static dfb::Brick brickOf(const py::handle& brick)
    {
        dfb::Brick result;
        if (const py::object id = brick.attr("id"); !toInteger(id, result.id))
            throw dfb::InvalidArgument("brick.id is " + shown(id) + ": it must be an int, 0 to 2**32 - 1");
        result.bounds = {pointOf(brick.attr("lower"), "brick.lower"), pointOf(brick.attr("upper"), "brick.upper")};
        return result;
    }

    static AnyCamera cameraOf(const py::object& camera)
    {
        if (py::isinstance<dfb::PerspectiveCamera>(camera))
            return camera.cast<dfb::PerspectiveCamera>();
        if (py::isinstance<dfb::MatrixCamera>(camera))
            return camera.cast<dfb::MatrixCamera>();
        throw dfb::InvalidArgument("the camera is " + shown(camera)
                                   + ": it must be a dfb.PerspectiveCamera or a dfb.MatrixCamera");
    }
};

} // namespace dfb_python
