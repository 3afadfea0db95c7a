// Converts errors of dfb to the exception dfb.Error, and exceptions of Python to text, for other threads and ranks.
#pragma once

#include <dfb/error.hpp>

#include <pybind11/pybind11.h>

#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <utility>

namespace dfb_python {

namespace py = pybind11;

// The enumerator's name, as in docs/errors.md.
inline const char* nameOf(dfb::ErrorKind kind)
{
    switch (kind) {
    case dfb::ErrorKind::InvalidArgument: return "InvalidArgument";
    case dfb::ErrorKind::TooManyInputs: return "TooManyInputs";
    case dfb::ErrorKind::DuplicateInput: return "DuplicateInput";
    case dfb::ErrorKind::UnannouncedInput: return "UnannouncedInput";
    case dfb::ErrorKind::NegativeChildren: return "NegativeChildren";
    case dfb::ErrorKind::MalformedMessage: return "MalformedMessage";
    case dfb::ErrorKind::Disagreement: return "Disagreement";
    case dfb::ErrorKind::UserCode: return "UserCode";
    case dfb::ErrorKind::Cancelled: return "Cancelled";
    case dfb::ErrorKind::TimedOut: return "TimedOut";
    case dfb::ErrorKind::Transport: return "Transport";
    case dfb::ErrorKind::MissingInput: return "MissingInput";
    }
    return "Unknown";
}

// Makes `error` the exception of this thread's Python, with the GIL. `cause`: a Python exception, or none.
inline void setError(const dfb::Error& error, const py::object& cause = py::none())
{
    const dfb::ErrorInfo& info = error.info();
    const auto number = [](std::int64_t value) -> py::object {
        return value < 0 ? py::object(py::none()) : py::object(py::int_(value));
    };
    const py::object type = py::module_::import("dfb._error").attr("Error");
    const py::object value =
        type(error.what(), nameOf(info.kind), info.message, number(info.rank), number(info.tile), number(info.frame),
             number(info.from), number(info.generation), number(info.source), number(info.expected), number(info.got));
    if (!cause.is_none())
        PyException_SetCause(value.ptr(), cause.inc_ref().ptr()); // it takes over the reference
    PyErr_SetObject(type.ptr(), value.ptr());
}

// The type and the text of an exception of Python.
inline std::string textOf(const py::handle& exception)
{
    std::string text = Py_TYPE(exception.ptr())->tp_name;
    try {
        const std::string detail = py::str(exception);
        if (!detail.empty())
            text += ": " + detail;
    } catch (const py::error_already_set&) { // its __str__ has thrown: the type must do
    }
    return text;
}

// The exception of `error`, with its traceback.
inline py::object valueOf(const py::error_already_set& error)
{
    const py::object value = error.value();
    if (error.trace())
        PyException_SetTraceback(value.ptr(), error.trace().ptr());
    return value;
}

// Makes `exception`, unchanged, the exception of this thread's Python.
inline void setAgain(const py::object& exception)
{
    PyErr_SetObject(reinterpret_cast<PyObject*>(Py_TYPE(exception.ptr())), exception.ptr());
}

// The first exception of Python that the callbacks of a call threw on this rank. Only with the GIL.
class Cause {
public:
    static std::shared_ptr<Cause> make()
    {
        return std::shared_ptr<Cause>(new Cause, [](Cause* cause) {
            const py::gil_scoped_acquire gil;
            delete cause;
        });
    }
    void offer(const py::object& exception)
    {
        if (first_.is_none())
            first_ = exception;
    }
    // Returns it and forgets it, so that it does not keep its frames alive.
    py::object take() noexcept { return std::exchange(first_, py::none()); }

    // For inTurn().
    std::mutex turn;

private:
    Cause() = default;
    py::object first_ = py::none();
};

// Calls body(), with the GIL. Returns its exception in a form that needs no GIL: for one of Python, its type and text.
// Null if there was none.
template <class Body>
std::exception_ptr caught(Cause& cause, const Body& body)
{
    try {
        body();
        return nullptr;
    } catch (const py::error_already_set& error) {
        const py::object exception = valueOf(error);
        cause.offer(exception);
        return std::make_exception_ptr(std::runtime_error(textOf(exception)));
    } catch (...) {
        return std::current_exception();
    }
}

// Takes the GIL on a thread that does not have it, and calls body(). Releases the GIL, and throws what caught()
// returns.
template <class Body>
void withPython(Cause& cause, const Body& body)
{
    std::exception_ptr thrown;
    {
        const py::gil_scoped_acquire gil;
        thrown = caught(cause, body);
    }
    if (thrown)
        std::rethrow_exception(thrown);
}

// As withPython(), but for one body at a time of a call of the library: Python releases the GIL now and then.
template <class Body>
void inTurn(Cause& cause, const Body& body)
{
    const std::lock_guard<std::mutex> turn(cause.turn);
    withPython(cause, body);
}

// Calls body() without the GIL, and returns its result. An exception of dfb becomes dfb.Error, whose cause is the
// exception of the callback that threw on this rank. A callback's KeyboardInterrupt or SystemExit is thrown as it is,
// because these must also end a program that goes on after errors.
template <class Body>
auto withoutGil(Cause& cause, const Body& body)
{
    try {
        const py::gil_scoped_release released;
        return body();
    } catch (const dfb::Error& error) {
        const py::object first = cause.take();
        if (first.is_none() || PyObject_IsInstance(first.ptr(), PyExc_Exception) == 1)
            setError(error, first);
        else
            setAgain(first);
        throw py::error_already_set();
    }
}

} // namespace dfb_python
