// Detects whether a type has a member, to define the traits of policies in one line each.
#pragma once

#include <dfb/version.hpp>

#include <type_traits>
#include <utility>

// Defines name<T>: whether the expression, in which T is the type, compiles. Several expressions are separated by
// commas.
#define DFB_DETECTS(name, ...)          \
    template <class T, class = void>    \
    inline constexpr bool name = false; \
    template <class T>                  \
    inline constexpr bool name<T, std::void_t<decltype(__VA_ARGS__)>> = true

// Defines name<T>: T::member, or `otherwise` for a type without it.
#define DFB_SETTING(type, name, otherwise, member) \
    template <class T, class = void>               \
    inline constexpr type name = otherwise;        \
    template <class T>                             \
    inline constexpr type name<T, std::void_t<decltype(T::member)>> = T::member
