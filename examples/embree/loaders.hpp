// Loaders: the ranks that load a scene together. Each reads a part of the files, and all come to the same scene.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <functional>
#include <memory>
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

    // A rank by itself.
    Loaders() = default;
    Loaders(int rank, int size, Gather gather) : rank_(rank), size_(size), gather_(std::move(gather)) {}

    int rank() const { return rank_; }
    int size() const { return size_; }

    // This rank's share of `count` things, which go to the ranks in equal runs: [first, second).
    std::pair<std::uint64_t, std::uint64_t> shareOf(std::uint64_t count) const
    {
        const auto at = [&](int rank) {
            const auto r = static_cast<std::uint64_t>(rank), n = static_cast<std::uint64_t>(size_);
            return count / n * r + count % n * r / n;
        };
        return {at(rank_), at(rank_ + 1)};
    }

    // Bytes of files that this rank has read. A reader adds to the counter, also after these loaders are gone.
    std::uint64_t bytesRead() const { return *bytesRead_; }
    const std::shared_ptr<std::uint64_t>& readCounter() const { return bytesRead_; }

    // Collective: calls `step`, which returns a std::vector<T>, on every rank; returns those of all, by rank. If it
    // throws on any rank, all throw std::runtime_error with the text of the lowest of those.
    template <class T, class Step>
    std::vector<T> gatherOf(const Step& step) const
    {
        static_assert(std::is_trivially_copyable_v<T>);
        if (size_ == 1)
            return step();
        Bytes own(1); // 1: what follows is an error
        const auto add = [&own](const void* data, std::size_t size) {
            const auto* first = static_cast<const std::byte*>(data);
            own.insert(own.end(), first, first + size);
        };
        try {
            const std::vector<T> values = step();
            add(values.data(), values.size() * sizeof(T));
        } catch (const std::exception& e) {
            const std::string text = e.what();
            own.assign(1, std::byte{1});
            add(text.data(), text.size());
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

    // Collective: what `make` returns on rank 0, which alone calls it, on all ranks. If it throws, all throw
    // std::runtime_error with its text. There is a function `arraysOf(T&, f)`, which calls f with the vectors that T is
    // made of.
    template <class T, class Make>
    T fromFirst(const Make& make) const
    {
        if (size_ == 1)
            return make();
        T value;
        Bytes bytes;
        gatherOf<char>([&] { // whether rank 0 has it
            if (rank_ == 0) {
                value = make();
                arraysOf(value, [&](const auto&... arrays) { (pack(arrays, bytes), ...); });
            }
            return std::vector<char>();
        });
        share(bytes);
        if (rank_ != 0) {
            const std::byte* at = bytes.data();
            arraysOf(value, [&](auto&... arrays) { (unpack(at, arrays), ...); });
        }
        return value;
    }

    // Collective: the lines of rank 0, which have no line ends, on all ranks.
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

private:
    // Rank 0's bytes to all, in parts, so that nobody holds them twice.
    void share(Bytes& bytes) const
    {
        const std::size_t most = std::size_t{4} << 20;
        for (std::size_t done = 0;;) {
            Bytes part;
            if (rank_ == 0) {
                const auto begin = bytes.begin() + static_cast<std::ptrdiff_t>(done);
                part.assign(begin, begin + static_cast<std::ptrdiff_t>(std::min(most, bytes.size() - done)));
            }
            part = std::move(gather_(part).front());
            if (rank_ != 0)
                bytes.insert(bytes.end(), part.begin(), part.end());
            done += part.size();
            if (part.size() < most)
                return;
        }
    }

    template <class T>
    static void pack(const std::vector<T>& array, Bytes& bytes)
    {
        static_assert(std::is_trivially_copyable_v<T>);
        const std::uint64_t count = array.size();
        const auto add = [&bytes](const void* data, std::size_t size) {
            const auto* first = static_cast<const std::byte*>(data);
            bytes.insert(bytes.end(), first, first + size);
        };
        add(&count, sizeof count);
        add(array.data(), array.size() * sizeof(T));
    }
    template <class T>
    static void unpack(const std::byte*& at, std::vector<T>& array)
    {
        std::uint64_t count = 0;
        std::memcpy(&count, at, sizeof count);
        at += sizeof count;
        array.resize(static_cast<std::size_t>(count));
        if (count > 0)
            std::memcpy(static_cast<void*>(array.data()), at, array.size() * sizeof(T));
        at += array.size() * sizeof(T);
    }

    int rank_ = 0, size_ = 1;
    Gather gather_;
    std::shared_ptr<std::uint64_t> bytesRead_ = std::make_shared<std::uint64_t>(0);
};

} // namespace example
