// DoubleDouble: the unevaluated sum of two doubles, for about 106 bits (Dekker 1971, Knuth 1969).
#pragma once

#include <dfb/version.hpp>

#include <cmath>
#include <cstdint>
#include <cstring>

DFB_NAMESPACE_BEGIN
namespace detail {

struct DoubleDouble {
    double high = 0, low = 0;

    static DoubleDouble sum(double a, double b) noexcept
    {
        const double s = a + b, part = s - a;
        return {s, (a - (s - part)) + (b - part)};
    }
    // sum() where b is no larger than a, or 0.
    static DoubleDouble sumOfOrdered(double a, double b) noexcept
    {
        const double s = a + b;
        return {s, b - (s - a)};
    }
    // A float has 24 bits, so its products with the halves of `a` are exact. This needs no fused multiply-add, which
    // some processors lack.
    static DoubleDouble product(double a, float b) noexcept
    {
#if defined(__FMA__) || defined(__FP_FAST_FMA)
        return product(a, static_cast<double>(b)); // here compilers may fuse `p` with sums that it goes into
#endif
        std::uint64_t bits = 0;
        std::memcpy(&bits, &a, sizeof bits);
        bits &= ~std::uint64_t{0x7ffffff};
        double head = 0;
        std::memcpy(&head, &bits, sizeof head);
        const double p = a * static_cast<double>(b);
        return {p, (head * static_cast<double>(b) - p) + (a - head) * static_cast<double>(b)};
    }
    static DoubleDouble product(double a, double b) noexcept
    {
        const double p = a * b;
        return {p, std::fma(a, b, -p)};
    }
};

inline DoubleDouble operator+(const DoubleDouble& a, const DoubleDouble& b) noexcept
{
    const DoubleDouble high = DoubleDouble::sum(a.high, b.high), low = DoubleDouble::sum(a.low, b.low);
    const DoubleDouble first = DoubleDouble::sum(high.high, high.low + low.high);
    return DoubleDouble::sum(first.high, first.low + low.low);
}
inline DoubleDouble operator*(const DoubleDouble& a, const DoubleDouble& b) noexcept
{
    const DoubleDouble p = DoubleDouble::product(a.high, b.high);
    return DoubleDouble::sum(p.high, p.low + (a.high * b.low + a.low * b.high));
}
inline DoubleDouble operator/(const DoubleDouble& a, double b) noexcept
{
    const double q = a.high / b;
    const DoubleDouble p = DoubleDouble::product(q, b);
    return DoubleDouble::sum(q, ((a.high - p.high) - p.low + a.low) / b);
}

} // namespace detail
DFB_NAMESPACE_END
