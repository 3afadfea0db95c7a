// FrameTerms: the parameters of a frame that must be equal on all ranks, and a search for those that are not.
#pragma once

#include <dfb/frame.hpp>

#include <array>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <type_traits>

DFB_NAMESPACE_BEGIN
namespace detail {

// FNV-1a over 64-bit words.
class Fingerprint {
public:
    void add(std::uint64_t v) noexcept { value_ = (value_ ^ v) * 1099511628211u; }
    std::uint64_t value() const noexcept { return value_; }

private:
    std::uint64_t value_ = 1469598103934665603u;
};

// The fields of FrameConfig; travels with each verdict as it is.
struct FrameTerms {
    std::uint64_t samplesHash = 0; // 0: there is no plan
    std::int64_t sampleCount = 0;  // of all tiles in the plan
    std::uint64_t accumulationId = 0;
    std::array<std::uint32_t, 4> background{}; // bits: so that a NaN equals itself
    std::int32_t passes = 1, maxLayers = 0, timeoutMs = 0;
    std::int32_t declared = 0, allowPartial = 0;
    std::int32_t rank = 0; // whose; the lowest of those that are alike

    static FrameTerms of(const FrameConfig& p, int rank)
    {
        FrameTerms t;
        if (p.samples) {
            Fingerprint f;
            for (const TileSamples& s : *p.samples) {
                f.add(static_cast<std::uint64_t>(s.first) << 32 | static_cast<std::uint32_t>(s.count));
                t.sampleCount += s.count;
            }
            t.samplesHash = f.value();
        }
        t.accumulationId = p.accumulationId;
        std::memcpy(t.background.data(), p.background.data(), sizeof t.background);
        t.passes = p.passes;
        t.maxLayers = p.maxLayers;
        t.timeoutMs = static_cast<std::int32_t>(p.timeout.count());
        t.declared = p.declared;
        t.allowPartial = p.allowPartial;
        t.rank = rank;
        return t;
    }

    // The first field that is not the same in both, with its values and ranks; "" if they are alike.
    std::string difference(const FrameTerms& o) const
    {
        FrameTerms its = o;
        its.rank = rank;
        if (std::memcmp(this, &its, sizeof its) == 0) // as nearly always
            return {};
        std::string text;
        const auto compare = [&](const char* name, bool differs, const std::string& here, const std::string& there) {
            if (text.empty() && differs)
                text = printed("FrameConfig::%s is %s on rank %d and %s on rank %d", name, here.c_str(), rank,
                               there.c_str(), o.rank);
        };
        const auto number = [&](const char* name, std::uint64_t here, std::uint64_t there) {
            compare(name, here != there, numberText(here), numberText(there));
        };
        const auto flag = [&](const char* name, std::int32_t here, std::int32_t there) {
            compare(name, here != there, here ? "true" : "false", there ? "true" : "false");
        };
        const auto planText = [&](const FrameTerms& t) {
            if (t.samplesHash == 0)
                return std::string("null");
            std::string plan = "a plan of " + numberText(static_cast<std::uint64_t>(t.sampleCount)) + " samples";
            if (sampleCount == o.sampleCount) // else that tells them apart
                plan += " with hash " + numberText(t.samplesHash);
            return plan;
        };
        compare("background", background != o.background, backgroundText(*this), backgroundText(o));
        number("passes", static_cast<std::uint64_t>(passes), static_cast<std::uint64_t>(o.passes));
        compare("samples", samplesHash != o.samplesHash, planText(*this), planText(o));
        number("maxLayers", static_cast<std::uint64_t>(maxLayers), static_cast<std::uint64_t>(o.maxLayers));
        number("accumulationId", accumulationId, o.accumulationId);
        flag("declared", declared, o.declared);
        number("timeout", static_cast<std::uint64_t>(timeoutMs), static_cast<std::uint64_t>(o.timeoutMs));
        flag("allowPartial", allowPartial, o.allowPartial);
        return text;
    }

private:
    static std::string numberText(std::uint64_t value)
    {
        return printed("%llu", static_cast<unsigned long long>(value)); // all are 0 or more
    }
    static std::string backgroundText(const FrameTerms& t)
    {
        std::array<float, 4> c{};
        std::memcpy(c.data(), t.background.data(), sizeof c);
        char text[80];
        std::snprintf(text, sizeof text, "(%.9g, %.9g, %.9g, %.9g)", static_cast<double>(c[0]),
                      static_cast<double>(c[1]), static_cast<double>(c[2]), static_cast<double>(c[3]));
        return text;
    }
};
static_assert(std::has_unique_object_representations_v<FrameTerms>); // no byte of a verdict is undefined

} // namespace detail
DFB_NAMESPACE_END
