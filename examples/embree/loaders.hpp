// Loaders: the ranks that load a scene together. Each reads a part of the files, and all come to the same scene.
#pragma once

#include "text.hpp"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <functional>
#include <memory>
#include <numeric>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace example {

class Loaders {
public:
    using Bytes = std::vector<std::byte>;
    // Collective: the bytes of each rank, by rank.
    using Gather = std::function<std::vector<Bytes>(const Bytes&)>;
    // Collective: the sums over all ranks, element by element.
    using Sum = std::function<std::vector<std::int64_t>(const std::vector<std::int64_t>&)>;

    // A rank by itself.
    Loaders() = default;
    Loaders(int rank, int size, Gather gather, Sum sum)
        : rank_(rank), size_(size), gather_(std::move(gather)), sum_(std::move(sum))
    {
    }

    int rank() const { return rank_; }
    int size() const { return size_; }

    // A rank's share [first, second) of `count` things, which are dealt out in equal consecutive runs. The second
    // function returns this rank's share.
    static std::pair<std::uint64_t, std::uint64_t> shareOf(std::uint64_t count, int rank, int size)
    {
        const auto at = [&](int i) {
            const auto r = static_cast<std::uint64_t>(i), n = static_cast<std::uint64_t>(size);
            return count / n * r + count % n * r / n;
        };
        return {at(rank), at(rank + 1)};
    }
    std::pair<std::uint64_t, std::uint64_t> shareOf(std::uint64_t count) const { return shareOf(count, rank_, size_); }

    // Bytes of files that this rank has read. A reader adds to the counter, also after these loaders are gone.
    std::uint64_t bytesRead() const { return *bytesRead_; }
    const std::shared_ptr<std::uint64_t>& readCounter() const { return bytesRead_; }

    // Collective: calls `step`, which returns a std::vector<T>, on every rank. Returns the results of all ranks, one
    // after the other. If it throws on any rank, all ranks throw std::runtime_error with the text of the lowest such
    // rank.
    template <class T, class Step>
    std::vector<T> gatherOf(const Step& step) const
    {
        static_assert(std::is_trivially_copyable_v<T>);
        if (size_ == 1)
            return step();
        Bytes own(1); // a first byte of 1: an error's text follows
        try {
            const std::vector<T> values = step();
            append(own, values.data(), values.size() * sizeof(T));
        } catch (const std::exception& e) {
            const std::string text = reasonOf(e);
            own.assign(1, std::byte{1});
            append(own, text.data(), text.size());
        }
        const std::vector<Bytes> ofRanks = gather_(own);
        for (const Bytes& bytes : ofRanks)
            if (bytes.front() != std::byte{0})
                throw std::runtime_error(
                    std::string(reinterpret_cast<const char*>(bytes.data()) + 1, bytes.size() - 1));
        std::vector<T> all;
        for (const Bytes& bytes : ofRanks) {
            const std::size_t count = (bytes.size() - 1) / sizeof(T), before = all.size();
            all.resize(before + count);
            if (count > 0)
                std::memcpy(static_cast<void*>(all.data() + before), bytes.data() + 1, count * sizeof(T));
        }
        return all;
    }

    // Collective: whether `step` returns true on all ranks. An exception counts as false.
    template <class Step>
    bool isOnAll(const Step& step) const
    {
        bool isSo = false;
        try {
            isSo = step();
        } catch (const std::exception&) { // the caller tries another way, which reports the error
        }
        for (const char other : gatherOf<char>([&] { return std::vector<char>{isSo ? '\1' : '\0'}; }))
            isSo = isSo && other != '\0';
        return isSo;
    }

    // Collective.
    std::vector<std::int64_t> sumOf(const std::vector<std::int64_t>& own) const { return size_ == 1 ? own : sum_(own); }

    // Collective: `count` is this rank's number of things. The things of all ranks follow one another, by rank. Returns
    // where those of each rank begin, and the end.
    std::vector<std::uint64_t> beginsOf(std::uint64_t count) const
    {
        std::vector<std::uint64_t> begins{0};
        for (const std::uint64_t of : gatherOf<std::uint64_t>([&] { return std::vector<std::uint64_t>{count}; }))
            begins.push_back(begins.back() + of);
        return begins;
    }

    // Collective: `parts` has one part for each rank and, last, one for all ranks. Returns what each rank has sent to
    // this one, by rank: first the part for this rank, then that for all. The ranks gather the parts in rounds; each
    // keeps what is for it, and frees a part when all of it is sent. What a rank has for itself is not sent.
    std::vector<Bytes> exchange(std::vector<Bytes> parts) const
    {
        const std::size_t ranks = static_cast<std::size_t>(size_), own = static_cast<std::size_t>(rank_);
        std::vector<Bytes> received(ranks);
        // The sizes of the parts of all ranks. The parts of one rank form a stream.
        const std::vector<std::uint64_t> sizes = gatherOf<std::uint64_t>([&] {
            received[own] = std::exchange(parts[own], Bytes());
            received[own].insert(received[own].end(), parts.back().begin(), parts.back().end());
            std::vector<std::uint64_t> mine;
            for (const Bytes& part : parts)
                mine.push_back(part.size());
            return mine;
        });
        if (size_ == 1)
            return received;
        std::uint64_t longest = 0;
        gatherOf<char>([&] { // if a rank has too little memory, all throw
            for (std::size_t source = 0; source < ranks; ++source) {
                const auto first = sizes.begin() + static_cast<std::ptrdiff_t>(source * (ranks + 1));
                longest = std::max(longest, std::accumulate(first, first + size_ + 1, std::uint64_t{0}));
                if (source != own)
                    received[source].reserve(static_cast<std::size_t>(first[rank_] + first[size_]));
            }
            return std::vector<char>();
        });
        // Calls f(part, from, to) for the pieces of parts of `source` that lie in bytes [begin, end) of its stream.
        const auto forParts = [&](std::size_t source, std::uint64_t begin, std::uint64_t end, const auto& f) {
            std::uint64_t first = 0;
            for (std::size_t part = 0; part <= ranks; ++part) {
                const std::uint64_t size = sizes[source * (ranks + 1) + part];
                const std::uint64_t from = std::max(begin, first), to = std::min(end, first + size);
                if (from < to)
                    f(part, static_cast<std::ptrdiff_t>(from - first), static_cast<std::ptrdiff_t>(to - first));
                first += size;
            }
        };
        const std::uint64_t most = std::max<std::uint64_t>(std::uint64_t{1} << 16, (std::uint64_t{1} << 20) / ranks);
        for (std::uint64_t done = 0; done < longest; done += most) {
            Bytes slice;
            forParts(own, done, done + most, [&](std::size_t part, std::ptrdiff_t from, std::ptrdiff_t to) {
                slice.insert(slice.end(), parts[part].begin() + from, parts[part].begin() + to);
                if (static_cast<std::size_t>(to) == parts[part].size())
                    parts[part] = Bytes();
            });
            const std::vector<Bytes> slices = gather_(slice);
            for (std::size_t source = 0; source < ranks; ++source) {
                auto at = slices[source].begin();
                forParts(source, done, done + most, [&](std::size_t part, std::ptrdiff_t from, std::ptrdiff_t to) {
                    if (source != own && (part == own || part == ranks))
                        received[source].insert(received[source].end(), at, at + (to - from));
                    at += to - from;
                });
            }
        }
        return received;
    }

    // Collective: returns the lines of rank 0 on all ranks. The lines have no line ends.
    std::vector<std::string> linesOfFirst(const std::vector<std::string>& lines) const
    {
        const std::vector<char> text = gatherOf<char>([&] {
            std::vector<char> own;
            for (std::size_t i = 0; i < lines.size() && rank_ == 0; ++i) {
                own.insert(own.end(), lines[i].begin(), lines[i].end());
                own.push_back('\n');
            }
            return own;
        });
        std::vector<std::string> all;
        for (auto begin = text.begin(), end = begin; begin != text.end(); begin = end + 1) {
            end = std::find(begin, text.end(), '\n');
            all.emplace_back(begin, end);
        }
        return all;
    }

    // pack() appends an array to some bytes; unpack() takes it from them and appends it to `array`.
    template <class T>
    static void pack(const std::vector<T>& array, Bytes& bytes)
    {
        static_assert(std::is_trivially_copyable_v<T>);
        const std::uint64_t count = array.size();
        append(bytes, &count, sizeof count);
        append(bytes, array.data(), array.size() * sizeof(T));
    }
    template <class T>
    static void unpack(const std::byte*& at, std::vector<T>& array)
    {
        std::uint64_t count = 0;
        std::memcpy(&count, at, sizeof count);
        at += sizeof count;
        const std::size_t before = array.size();
        array.resize(before + static_cast<std::size_t>(count));
        if (count > 0)
            std::memcpy(static_cast<void*>(array.data() + before), at, static_cast<std::size_t>(count) * sizeof(T));
        at += static_cast<std::size_t>(count) * sizeof(T);
    }

private:
    static void append(Bytes& bytes, const void* data, std::size_t size)
    {
        const auto* first = static_cast<const std::byte*>(data);
        bytes.insert(bytes.end(), first, first + size);
    }

    int rank_ = 0, size_ = 1;
    Gather gather_;
    Sum sum_;
    std::shared_ptr<std::uint64_t> bytesRead_ = std::make_shared<std::uint64_t>(0);
};

} // namespace example
