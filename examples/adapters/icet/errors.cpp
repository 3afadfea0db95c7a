#include "errors.hpp"

#include "context.hpp"

#include <cstdio>
#include <new>

namespace dfb_icet {

namespace {

// The kept error, in common for all contexts as in IceT: the first one since icetGetError(), or the first error after
// warnings.
IceTEnum keptType = ICET_NO_ERROR, keptLevel = 0;

IceTEnum typeOf(const std::exception& error)
{
    if (const auto* own = dynamic_cast<const Error*>(&error))
        return own->type;
    if (dynamic_cast<const dfb::InvalidArgument*>(&error))
        return ICET_INVALID_VALUE;
    return dynamic_cast<const std::bad_alloc*>(&error) ? ICET_OUT_OF_MEMORY : ICET_INVALID_OPERATION;
}

const char* nameOf(IceTEnum level)
{
    return level == ICET_DIAG_ERRORS ? "ERROR" : level == ICET_DIAG_WARNINGS ? "WARNING" : "DEBUG";
}

// Each level contains the bits of the more severe ones.
void print(IceTEnum level, const std::string& text)
{
    const IceTContextStruct* context = icetGetContext();
    const IceTBitField wanted = context ? context->settings.diagnostics : IceTBitField{ICET_DIAG_WARNINGS};
    if ((wanted & level) != level)
        return;
    if (context && (wanted & ICET_DIAG_ALL_NODES) != 0)
        std::printf("ICET,%d:%s: %s\n", context->rank(), nameOf(level), text.c_str());
    else if (!context || context->rank() == 0)
        std::printf("ICET:%s: %s\n", nameOf(level), text.c_str());
    std::fflush(stdout);
}

void keep(IceTEnum type, IceTEnum level)
{
    if (keptType != ICET_NO_ERROR && level >= keptLevel)
        return;
    keptType = type;
    keptLevel = level;
}

} // namespace

void raiseError(const char* function, const std::exception& error)
{
    keep(typeOf(error), ICET_DIAG_ERRORS);
    print(ICET_DIAG_ERRORS, std::string(function) + ": " + error.what());
}

void raiseWarning(const char* function, IceTEnum type, const std::string& text)
{
    keep(type, ICET_DIAG_WARNINGS);
    print(ICET_DIAG_WARNINGS, std::string(function) + ": " + text);
}

void sayDebug(const std::string& text) { print(ICET_DIAG_DEBUG, text); }

IceTContextStruct& currentContext()
{
    if (IceTContext context = icetGetContext())
        return *context;
    throw Error(ICET_INVALID_OPERATION, "there is no current context: call icetCreateContext() or icetSetContext()");
}

extern "C" IceTEnum icetGetError()
{
    const IceTEnum type = keptType;
    keptType = ICET_NO_ERROR;
    return type;
}

extern "C" void icetDiagnostics(IceTBitField mask)
{
    inContext("icetDiagnostics", [&](IceTContextStruct& context) { context.settings.diagnostics = mask; });
}

} // namespace dfb_icet
