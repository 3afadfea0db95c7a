// The functions of an IceT in a shared library, so that one program can use two of them.
#pragma once

#include <IceT.h>

#include <dlfcn.h>

#include <stdexcept>
#include <string>

namespace icet_test {

#define DFB_ICET_FUNCTIONS(USE)         \
    USE(icetAddTile)                    \
    USE(icetBoundingBoxd)               \
    USE(icetBoundingVertices)           \
    USE(icetCompositeImage)             \
    USE(icetCompositeMode)              \
    USE(icetCompositeOrder)             \
    USE(icetCopyState)                  \
    USE(icetCreateContext)              \
    USE(icetDataReplicationGroup)       \
    USE(icetDataReplicationGroupColor)  \
    USE(icetDestroyContext)             \
    USE(icetDiagnostics)                \
    USE(icetDisable)                    \
    USE(icetDrawCallback)               \
    USE(icetDrawFrame)                  \
    USE(icetEnable)                     \
    USE(icetGetBitFieldv)               \
    USE(icetGetContext)                 \
    USE(icetGetDoublev)                 \
    USE(icetGetEnumv)                   \
    USE(icetGetError)                   \
    USE(icetGetFloatv)                  \
    USE(icetGetIntegerv)                \
    USE(icetGetPointerv)                \
    USE(icetGetSingleImageStrategyName) \
    USE(icetGetStrategyName)            \
    USE(icetImageCopyColorf)            \
    USE(icetImageCopyColorub)           \
    USE(icetImageCopyDepthf)            \
    USE(icetImageGetColorFormat)        \
    USE(icetImageGetColorcf)            \
    USE(icetImageGetColorcub)           \
    USE(icetImageGetColorcui)           \
    USE(icetImageGetColorf)             \
    USE(icetImageGetColorub)            \
    USE(icetImageGetColorui)            \
    USE(icetImageGetDepthFormat)        \
    USE(icetImageGetDepthcf)            \
    USE(icetImageGetDepthf)             \
    USE(icetImageGetHeight)             \
    USE(icetImageGetNumPixels)          \
    USE(icetImageGetWidth)              \
    USE(icetImageIsNull)                \
    USE(icetIsEnabled)                  \
    USE(icetPhysicalRenderSize)         \
    USE(icetResetTiles)                 \
    USE(icetSetColorFormat)             \
    USE(icetSetContext)                 \
    USE(icetSetDepthFormat)             \
    USE(icetSingleImageStrategy)        \
    USE(icetStrategy)                   \
    USE(icetWallTime)

struct Api {
    // Throws std::runtime_error. The library stays loaded.
    Api(const char* libraryName, const std::string& file)
        : name(libraryName), library(dlopen(file.c_str(), RTLD_NOW | RTLD_LOCAL | RTLD_DEEPBIND))
    {
        if (!library)
            throw std::runtime_error(dlerror());
#define DFB_FIND(function) find(function, #function);
        DFB_ICET_FUNCTIONS(DFB_FIND)
#undef DFB_FIND
    }

    template <class Function>
    void find(Function& function, const char* functionName) const
    {
        function = reinterpret_cast<Function>(dlsym(library, functionName));
        if (!function)
            throw std::runtime_error(name + " has no " + functionName);
    }

    std::string name;
    void* library;
#define DFB_DECLARE(function) decltype(&::function) function = nullptr;
    DFB_ICET_FUNCTIONS(DFB_DECLARE)
#undef DFB_DECLARE
};

} // namespace icet_test
