// The errors of dfb: a record of an error and its place, and the exceptions that carry it.
//
// InvalidArgument is thrown by the call that was wrong; collective calls throw it on all ranks unless they say
// otherwise. An error in the background of a frame comes out of Frame::end() as FrameError, the same on every rank.
#pragma once

#include <dfb/compiled.hpp>

#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

DFB_NAMESPACE_BEGIN
namespace detail {

inline std::string printed(const char* format, std::va_list values)
{
    std::va_list again;
    va_copy(again, values);
    std::string text(static_cast<std::size_t>(std::vsnprintf(nullptr, 0, format, again)) + 1, ' ');
    va_end(again);
    std::vsnprintf(text.data(), text.size(), format, values);
    text.pop_back();
    return text;
}

// The text that printf() would write. It compiles faster than concatenated strings, of which there would be many.
[[gnu::format(printf, 1, 2)]] inline std::string printed(const char* format, ...)
{
    std::va_list values;
    va_start(values, format);
    std::string text = printed(format, values);
    va_end(values);
    return text;
}

} // namespace detail

// See docs/errors.md for the causes and remedies.
enum class ErrorKind : std::uint32_t {
    InvalidArgument,  // a call with a wrong argument; in a FrameError: a call between begin() and end()
    TooManyInputs,    // a generation has received more inputs than were announced for it
    DuplicateInput,   // the same (pass, generation, source, part) came twice for one tile
    UnannouncedInput, // an input of a generation or source that nobody announced
    NegativeChildren, // an input announced fewer than zero children
    MalformedMessage, // bytes off the wire that are not a message of this framebuffer
    Disagreement,     // ranks began a frame with different parameters, or inputs came after their tiles were done
    UserCode,         // an exception out of the program's code: a renderer, a camera, an operation, a codec, onTile
    Cancelled,        // a frame was cancelled, or left without end()
    TimedOut,         // a frame was not complete in time
    Transport,        // the transport reported a failure
    MissingInput      // a frame cannot become complete: all ranks wait for it, and nothing is under way any more
};

inline const char* toString(ErrorKind kind)
{
    switch (kind) {
    case ErrorKind::InvalidArgument: return "invalid argument";
    case ErrorKind::TooManyInputs: return "too many inputs";
    case ErrorKind::DuplicateInput: return "duplicate input";
    case ErrorKind::UnannouncedInput: return "unannounced input";
    case ErrorKind::NegativeChildren: return "negative number of children";
    case ErrorKind::MalformedMessage: return "malformed message";
    case ErrorKind::Disagreement: return "ranks disagree";
    case ErrorKind::UserCode: return "exception in user code";
    case ErrorKind::Cancelled: return "frame cancelled";
    case ErrorKind::TimedOut: return "timed out";
    case ErrorKind::Transport: return "transport failure";
    case ErrorKind::MissingInput: return "missing input, all ranks wait and nothing is under way";
    }
    return "unknown error";
}

// An error and its place. A negative number means "does not apply".
struct ErrorInfo {
    ErrorKind kind = ErrorKind::InvalidArgument;
    // The rank where it went wrong: its code threw, it cancelled or left the frame, it passed a wrong argument, or it
    // is lost. For wrong or missing inputs and messages: the rank that noticed, which may not have caused it.
    int rank = -1;
    // The rank that the input or message came from. If something did not come (TimedOut, MissingInput, Transport): the
    // rank that should have sent it; for a missing input of a tile, the rank that announced it.
    int from = -1;
    std::int64_t frame = -1;
    std::int64_t tile = -1;
    std::int64_t pass = -1;
    std::int64_t generation = -1;
    std::int64_t source = -1; // brick id; the place of an image with ImageBlend::InOrder; else the rank
    std::int64_t expected = -1;
    std::int64_t got = -1;
    std::string message; // the detail in words, may be empty

    // One line with all that applies.
    std::string describe() const;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE std::string ErrorInfo::describe() const
{
    std::string text = detail::printed("dfb: %s", toString(kind));
    auto add = [&text, separator = ": "](const char* name, std::int64_t value) mutable {
        if (value < 0)
            return;
        text += detail::printed("%s%s %lld", separator, name, static_cast<long long>(value));
        separator = ", ";
    };
    const bool isLate =
        kind == ErrorKind::TimedOut || kind == ErrorKind::MissingInput || (kind == ErrorKind::Transport && from >= 0);
    const bool isHere = kind == ErrorKind::UserCode || kind == ErrorKind::Cancelled
                        || kind == ErrorKind::InvalidArgument || (kind == ErrorKind::Transport && !isLate);
    add(isHere ? "rank" : "noticed by rank", rank);
    const bool isInput = kind == ErrorKind::TooManyInputs || kind == ErrorKind::DuplicateInput
                         || kind == ErrorKind::UnannouncedInput || kind == ErrorKind::NegativeChildren;
    add(isInput           ? "from rank"
        : !isLate         ? "in a message from rank"
        : generation >= 0 ? "announced by rank"
                          : "waiting for rank",
        from);
    add("frame", frame);
    add("tile", tile);
    add("pass", pass);
    add("generation", generation);
    add("source", source);
    add("expected", expected);
    add("got", got);
    if (!message.empty())
        text += ": " + message;
    return text;
}
#endif

namespace detail {

// Makes a record of an error that was noticed on that rank.
inline ErrorInfo errorInfo(ErrorKind kind, std::string message, int rank = -1)
{
    ErrorInfo info;
    info.kind = kind;
    info.rank = rank;
    info.message = std::move(message);
    return info;
}

} // namespace detail

// The base of all exceptions of the library, except OutOfMemory. what() is info().describe().
class Error : public std::runtime_error {
public:
    // The exception keeps `whileThrown` alive.
    explicit Error(ErrorInfo info, std::shared_ptr<const void> whileThrown = {})
        : std::runtime_error(info.describe()), info_(std::move(info)), whileThrown_(std::move(whileThrown))
    {
    }
    const ErrorInfo& info() const noexcept { return info_; }

private:
    ErrorInfo info_;
    std::shared_ptr<const void> whileThrown_;
};

// A wrong argument, or a call that is not allowed now or on this thread. No framebuffer has changed.
class InvalidArgument : public Error {
public:
    using Error::Error;
    explicit InvalidArgument(std::string message)
        : Error(detail::errorInfo(ErrorKind::InvalidArgument, std::move(message)))
    {
    }
};

// A frame failed. Every rank throws the same one out of Frame::end(); the framebuffer can begin a new frame.
class FrameError : public Error {
public:
    using Error::Error;
};

// The transport cannot work or has failed; the framebuffer is of no further use.
class TransportError : public Error {
public:
    using Error::Error;
    explicit TransportError(std::string message, int rank = -1)
        : Error(detail::errorInfo(ErrorKind::Transport, std::move(message), rank))
    {
    }
};

namespace detail {

// Throws InvalidArgument, with the text that printf() would write.
[[noreturn, gnu::format(printf, 1, 2)]] inline void failArgument(const char* format, ...)
{
    std::va_list values;
    va_start(values, format);
    std::string text = printed(format, values);
    va_end(values);
    throw InvalidArgument(std::move(text));
}

[[noreturn]] inline void failMalformed(const char* message, std::int64_t expected = -1, std::int64_t got = -1)
{
    ErrorInfo info = errorInfo(ErrorKind::MalformedMessage, message);
    info.expected = expected;
    info.got = got;
    throw Error(std::move(info));
}

} // namespace detail
DFB_NAMESPACE_END
