// Writing .exr files.
#include "exr.hpp"

#include "output.hpp"

#if defined(DFB_EXAMPLE_HAS_OPENEXR)
#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfOutputFile.h>
#include <ImfStringAttribute.h>
#endif

#include <cstddef>
#include <exception>
#include <initializer_list>
#include <stdexcept>

namespace example {

void writeExr([[maybe_unused]] const std::string& path, [[maybe_unused]] const dfb::Image& image,
              [[maybe_unused]] dfb::ChannelMask layers, [[maybe_unused]] const std::string& comment)
{
#if defined(DFB_EXAMPLE_HAS_OPENEXR)
    try {
        Imf::Header header(image.width(), image.height());
        header.compression() = Imf::ZIP_COMPRESSION;
        header.insert("comments", Imf::StringAttribute(comment));
        Imf::FrameBuffer pixels;
        const auto width = static_cast<std::size_t>(image.width());
        // Adds channels of 4 bytes, which are adjacent in a pixel.
        const auto add = [&](Imf::PixelType type, std::initializer_list<const char*> names, const void* first) {
            // OpenEXR uses one type for reading and writing, so it wants a non-const pointer.
            char* at = const_cast<char*>(static_cast<const char*>(first));
            for (const char* name : names) {
                header.channels().insert(name, Imf::Channel(type));
                pixels.insert(name, Imf::Slice(type, at, 4 * names.size(), 4 * names.size() * width));
                at += 4;
            }
        };
        add(Imf::FLOAT, {"R", "G", "B", "A"}, image.rgba32f());
        if (layers & dfb::depthChannel)
            add(Imf::FLOAT, {"Z"}, image.depth());
        if (layers & dfb::normalChannel)
            add(Imf::FLOAT, {"N.X", "N.Y", "N.Z"}, image.normal());
        if (layers & dfb::albedoChannel)
            add(Imf::FLOAT, {"albedo.R", "albedo.G", "albedo.B"}, image.albedo());
        if (layers & dfb::positionChannel)
            add(Imf::FLOAT, {"P.X", "P.Y", "P.Z"}, image.position());
        if (layers & dfb::primitiveIdChannel)
            add(Imf::UINT, {"id.primitive"}, image.primitiveId());
        if (layers & dfb::instanceIdChannel)
            add(Imf::UINT, {"id.instance"}, image.instanceId());
        Imf::OutputFile file(path.c_str(), header);
        file.setFrameBuffer(pixels);
        file.writePixels(image.height());
    } catch (const std::exception& e) {
        detail::failToWrite(path, e.what());
    }
#else
    throw std::runtime_error("this dfb_render was built without OpenEXR");
#endif
}

} // namespace example
