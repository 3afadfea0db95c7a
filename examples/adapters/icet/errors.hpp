// Errors as IceT reports them: printed as icetDiagnostics() says, and kept for icetGetError().
#pragma once

#include <IceT.h>

#include <exception>
#include <stdexcept>
#include <string>

struct IceTContextStruct;

namespace dfb_icet {

// An error that a client gets. `type` is what icetGetError() returns.
class Error : public std::runtime_error {
public:
    Error(IceTEnum errorType, const std::string& text) : std::runtime_error(text), type(errorType) {}
    IceTEnum type;
};

// Each reports an error, a warning or a message, as the diagnostics of the current context say. Without a context, all
// except debug messages are printed.
void raiseError(const char* function, const std::exception& error);
void raiseWarning(const char* function, IceTEnum type, const std::string& text);
void sayDebug(const std::string& text);

// The context that calls work on. Throws Error if there is none.
IceTContextStruct& currentContext();

// Returns what body() does. No exception leaves an IceT function: it becomes an IceT error, and 0 or null is returned.
template <class Body>
auto guarded(const char* function, const Body& body) -> decltype(body())
{
    try {
        return body();
    } catch (const std::exception& e) {
        raiseError(function, e);
    } catch (...) {
        raiseError(function, Error(ICET_INVALID_OPERATION, "an exception of an unknown type"));
    }
    return decltype(body())();
}

// Calls body(context) in the same way, with the current context.
template <class Body>
void inContext(const char* function, const Body& body)
{
    guarded(function, [&] { body(currentContext()); });
}

} // namespace dfb_icet
