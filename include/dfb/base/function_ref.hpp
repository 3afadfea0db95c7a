// FunctionRef: a reference to a callable, valid during the call that it is an argument of. It is two pointers. A
// function that takes one need not be a template, which would be instantiated for each lambda. A FunctionRef that
// returns nothing drops what the callable returns.
#pragma once

#include <dfb/version.hpp>

#include <utility>

DFB_NAMESPACE_BEGIN
namespace detail {

template <class Signature>
class FunctionRef;

template <class Result, class... Arguments>
class FunctionRef<Result(Arguments...)> {
public:
    template <class Callable>
    FunctionRef(const Callable& callable)
        : callable_(&callable), call_([](const void* any, Arguments... arguments) -> Result {
              return static_cast<Result>((*static_cast<const Callable*>(any))(std::forward<Arguments>(arguments)...));
          })
    {
    }
    template <class Return>
    FunctionRef(Return (&function)(Arguments...))
        : callable_(reinterpret_cast<const void*>(&function)),
          call_([](const void* any, Arguments... arguments) -> Result {
              return static_cast<Result>(reinterpret_cast<Return (*)(Arguments...)>(const_cast<void*>(any))(
                  std::forward<Arguments>(arguments)...));
          })
    {
    }

    Result operator()(Arguments... arguments) const { return call_(callable_, std::forward<Arguments>(arguments)...); }

private:
    const void* callable_;
    Result (*call_)(const void*, Arguments...);
};

} // namespace detail
DFB_NAMESPACE_END
