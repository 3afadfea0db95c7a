// Agreement: the content of the reduction with which a framebuffer is made. It says whether all ranks have the same
// configuration.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/operations.hpp>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cxxabi.h>
#include <exception>
#include <limits>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// FNV-1a over a 64-bit word of each element.
template <class List, class WordOf>
std::uint64_t fingerprint(const List& list, const WordOf& wordOf)
{
    std::uint64_t value = 1469598103934665603u;
    for (const auto& element : list)
        value = (value ^ static_cast<std::uint64_t>(wordOf(element))) * 1099511628211u;
    return value;
}

// The configuration of one rank, or its error. Combined, it says whether those of all ranks are right and equal, and
// which ranks share a node.
struct Agreement {
    struct OnNode {
        std::int32_t rank = 0, first = 0; // the lowest rank of its node
        std::int32_t hasFarRanks = 0;     // 1: it shares no memory with some other rank
    };

    bool fine = true;
    std::string text; // of Settings; or the error
    int rank = 0;     // the lowest rank that has it; -1 if two ranks differ
    std::vector<OnNode> nodes{};

    // Names and values, a line each.
    class Settings {
    public:
        void add(const char* name, const char* value) { text_ += printed("%s%c%s\n", name, separator, value); }
        void add(const char* name, const std::string& value) { add(name, value.c_str()); }
        template <class Value>
        void add(const char* name, Value value)
        {
            if constexpr (std::is_same_v<Value, bool>)
                add(name, value ? "true" : "false");
            else if constexpr (std::is_floating_point_v<Value>)
                add(name, digitsOf(value));
            else
                add(name, std::to_string(value));
        }
        const std::string& text() const noexcept { return text_; }

    private:
        std::string text_;
    };

    // `checksums`: see NetworkConfig; `sent`: those of the tile operation's channels that travel; `owners`: the owner
    // map's answers.
    static Agreement of(const OperationTraits& operations, const FrameBufferConfig& c, bool checksums, OnNode here,
                        ChannelMask sent, const std::vector<int>& owners)
    {
        Settings s;
        s.add("the version of dfb", printed("%d.%d", DFB_VERSION_MAJOR, DFB_VERSION_MINOR));
        s.add("width", c.image.width);
        s.add("height", c.image.height);
        s.add(tileOperation, operations.tileOp);
        s.add(pixelOperation, operations.pixelOp);
        s.add("the size of tiles", printed("%dx%d", operations.tileWidth, operations.tileHeight));
        s.add("the mask of channels", operations.channels);
        s.add("the mask of channels that travel", sent);
        s.add("format", nameOf(c.image.format));
        s.add("depth", c.image.depth);
        s.add("aux", c.image.aux);
        s.add("dither", c.image.dither);
        s.add("displayRank", c.image.displayRank);
        s.add("framesInFlight", c.framesInFlight);
        s.add("the hash of ownerMap", fingerprint(owners, [](int owner) { return owner; }));
        s.add("the id of messages.codec", c.messages.codec ? c.messages.codec->id() : 0);
        s.add("messages.compression", c.messages.compression == CompressionMode::Auto ? "Auto" : "Always");
        s.add("precision.color", nameOf(c.precision.color));
        s.add("precision.budget", c.precision.budget);
        s.add("precision.isHalfLevel", c.precision.isHalfLevel);
        s.add("precision.maxColor", c.precision.maxColor);
        s.add("minTransmittance", c.minTransmittance);
        s.add("messages.poolBytes", c.messages.poolBytes);
        s.add("checksums", checksums);
        return {true, s.text(), here.rank, {here}};
    }

    SmallBytes bytes() const
    {
        SmallBytes out;
        out.put(static_cast<std::uint8_t>(fine));
        out.put(static_cast<std::int32_t>(rank));
        out.putText(text);
        for (const OnNode& its : nodes)
            out.put(its);
        return out;
    }

    static Agreement from(const SmallBytes& bytes)
    {
        ByteReader in(bytes);
        Agreement a;
        const auto fine = in.get<std::uint8_t>();
        in.require(fine <= 1);
        a.fine = fine != 0;
        a.rank = in.get<std::int32_t>();
        a.text = in.getText();
        while (in.left() > 0) {
            const auto its = in.get<OnNode>();
            in.require(its.first >= 0 && its.first <= its.rank);
            a.nodes.push_back(its);
        }
        return a;
    }

    static SmallBytes combine(const SmallBytes& first, const SmallBytes& second)
    {
        Agreement a = from(first);
        const Agreement b = from(second);
        if (!a.fine)
            return first;
        if (!b.fine)
            return second;
        if (a.text != b.text)
            return Agreement{false, difference(a.text, a.rank, b.text, b.rank) + ": it must be the same on all ranks",
                             -1}
                .bytes();
        a.nodes.insert(a.nodes.end(), b.nodes.begin(), b.nodes.end());
        return a.bytes();
    }

    // Which settings differ, in words, and their values on both ranks. A hash is shown only if nothing else differs, as
    // it says least.
    static std::string difference(const std::string& a, int rank, const std::string& b, int otherRank)
    {
        const auto as = settingsOf(a), bs = settingsOf(b);
        const std::string ranks[] = {printed(" on rank %d", rank), printed(" on rank %d", otherRank)};
        std::string differing;
        for (std::size_t i = 0; i < as.size() && as.size() == bs.size(); ++i)
            if (const auto& [name, value] = as[i]; as[i] != bs[i] && (name.find(hash) != 0 || differing.empty()))
                differing += (differing.empty() ? "" : "; ") + name + " is " + readable(name, value) + ranks[0]
                             + " and " + readable(name, bs[i].second) + ranks[1];
        return differing.empty() ? "the settings" + ranks[0] + " are not those" + ranks[1] : differing;
    }

private:
    static constexpr const char* tileOperation = "the tile operation";
    static constexpr const char* pixelOperation = "the pixel operation";
    static constexpr const char* hash = "the hash of ";
    static constexpr char separator = '=';

    // The fewest digits that give this value back.
    template <class Value>
    static std::string digitsOf(Value value)
    {
        char digits[40];
        const int most = std::numeric_limits<Value>::max_digits10;
        for (int count = 1; count <= most; ++count) {
            std::snprintf(digits, sizeof digits, "%.*g", count, static_cast<double>(value));
            if (static_cast<Value>(std::strtod(digits, nullptr)) == value)
                break;
        }
        return digits;
    }

    // Types are compared by their mangled names, and shown as a program writes them: demangled, without the namespace
    // of the version.
    static std::string readable(const std::string& name, const std::string& value)
    {
        if (name != tileOperation && name != pixelOperation)
            return value;
        const std::unique_ptr<char, decltype(&std::free)> written(
            abi::__cxa_demangle(value.c_str(), nullptr, nullptr, nullptr), &std::free);
        std::string text = written ? written.get() : value;
        const std::string version = printed("v%d_%d::", DFB_VERSION_MAJOR, DFB_VERSION_MINOR);
        for (std::size_t at; (at = text.find(version)) != std::string::npos;)
            text.erase(at, version.size());
        return text;
    }

    static std::vector<std::pair<std::string, std::string>> settingsOf(const std::string& text)
    {
        std::vector<std::pair<std::string, std::string>> settings;
        for (std::size_t at = 0; at < text.size();) {
            const std::size_t end = std::min(text.find('\n', at), text.size());
            const std::string line = text.substr(at, end - at);
            const std::size_t middle = std::min(line.find(separator), line.size());
            settings.push_back({line.substr(0, middle), line.substr(std::min(middle + 1, line.size()))});
            at = end + 1;
        }
        return settings;
    }
};

// Throws InvalidArgument if a connection of `size` ranks cannot work with this configuration.
inline void checkConfig(const FrameBufferConfig& c, const OperationTraits& operations, int size,
                        std::chrono::milliseconds peerTimeout)
{
    if (c.image.displayRank < 0 || c.image.displayRank >= size)
        failArgument("the display rank is %d of %d", c.image.displayRank, size);
    if (c.framesInFlight < 1 || (c.framesInFlight > 1 && operations.keepsState))
        failArgument("there cannot be %d frames in flight: 1 or more, and only 1 if the tile operation keeps state",
                     c.framesInFlight);
    for (std::size_t channel = 0; channel < channelCount; ++channel)
        if (hasChannel(c.image.aux & ~(operations.channels & imageAuxChannels), channel))
            failArgument(hasChannel(imageAuxChannels, channel)
                             ? "ImageConfig::aux has %s, which the inputs of this tile operation do not have: see its "
                               "template arguments"
                             : "ImageConfig::aux has %s, which is no auxiliary channel of an image",
                         channelNames[channel]);
    constexpr long long longest = longestTimeout.count();
    if (const long long ms = peerTimeout.count(); ms != 0 && (ms < 100 || ms > longest))
        failArgument("a time-out for peers of %lld ms: 0, or 100 to %lld", ms, longest);
    if (const long long ms = c.quiet.count(); ms < 1 || ms > longest)
        failArgument("`quiet` is %lld ms: it must be 1 to %lld", ms, longest);
    if (c.messages.codec && c.messages.codec->id() == 0)
        failArgument("messages.codec has the id 0, which in a message means none");
    const Precision& w = c.precision;
    if (w.isHalfLevel && (w.budget > 0 || w.color != WireFormat::Float32))
        failArgument("half a level, and another precision");
    if (!(w.budget >= 0) || !(w.maxColor >= 1e-30f && w.maxColor <= 1e30f))
        failArgument("an error budget of %f, colours up to %f", w.budget, static_cast<double>(w.maxColor));
    if (w.color == WireFormat::Bytes)
        failArgument("the format bytes is that of inputs of 8 bits, and cannot be asked for");
    if (!(c.minTransmittance >= 0 && c.minTransmittance < 1))
        failArgument("a least transmittance of %f", static_cast<double>(c.minTransmittance));
}

// Finds out whether all ranks have the same configuration, which makeMine() returns, and returns what all have.
// Collective. Throws InvalidArgument on all ranks if the configurations differ or makeMine() throws on any rank. No
// rank throws before all know the reason: the first to throw may destroy the connection, and a rank that does not know
// the reason by then would report another error.
inline Agreement agree(Mailbox& mailbox, FunctionRef<Agreement()> makeMine)
{
    Agreement mine;
    try {
        mine = makeMine();
    } catch (const InvalidArgument& e) {
        mine = {false, e.info().message, mailbox.rank()};
    } catch (const std::exception& e) { // the others must not wait for this rank
        mine = {false, e.what(), mailbox.rank()};
    } catch (...) {
        mine = {false, "an exception that is not a std::exception", mailbox.rank()};
    }
    auto all = Agreement::from(mailbox.reduce(mine.bytes(), Agreement::combine));
    if (!all.fine) {
        try {
            mailbox.reduce({}, [](const SmallBytes& a, const SmallBytes&) { return a; });
        } catch (const TransportError&) {
            // A rank has left already, so all know the reason.
        }
        throw InvalidArgument(errorInfo(ErrorKind::InvalidArgument, all.text, all.rank),
                              mailbox.connection().throwByAll());
    }
    mailbox.connection().setAlike();
    return all;
}

} // namespace detail
DFB_NAMESPACE_END
