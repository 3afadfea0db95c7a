// FunctionRef: a callable that is only called during the call that it is an argument of. Two pointers, so what takes
// one need be no template, of which each lambda would make another function.
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
              return (*static_cast<const Callable*>(any))(std::forward<Arguments>(arguments)...);
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
