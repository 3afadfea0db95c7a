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
    using Numbers = std::vector<std::int64_t>;
    using Bytes = std::vector<std::byte>;
    // Collective: the least over the ranks of each number; and the bytes of each rank, by rank.
    using Reduce = std::function<Numbers(const Numbers&)>;
    using Gather = std::function<std::vector<Bytes>(const Bytes&)>;

    // A rank by itself.
    Loaders() = default;
    Loaders(int rank, int size, Reduce least, Gather gather)
        : rank_(rank), size_(size), least_(std::move(least)), gather_(std::move(gather))
    {
    }

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

    // Collective: calls `step`, which returns `count` floats, on every rank; returns the least of each over the ranks.
    // If it throws on any rank, all throw std::runtime_error with the text of the lowest of those.
    template <class Step>
    std::vector<float> leastOf(std::size_t count, const Step& step) const
    {
        Numbers numbers(count + 1, size_);
        std::string error;
        try {
            const std::vector<float> values = step();
            for (std::size_t i = 0; i < count; ++i)
                numbers[i + 1] = inOrder(values.at(i));
        } catch (const std::exception& e) {
            error = textOf(e);
            numbers[0] = rank_;
        }
        if (size_ > 1)
            numbers = least_(numbers);
        if (numbers[0] < size_)
            throw std::runtime_error(size_ > 1 ? textOfRank(static_cast<std::size_t>(numbers[0]), error) : error);
        std::vector<float> values(count);
        for (std::size_t i = 0; i < count; ++i)
            values[i] = ofOrder(numbers[i + 1]);
        return values;
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
        std::string error;
        Bytes bytes;
        if (rank_ == 0) {
            try {
                value = make();
                arraysOf(value, [&](const auto&... arrays) { (pack(arrays, bytes), ...); });
            } catch (const std::exception& e) {
                error = textOf(e);
            }
        }
        error = textOfRank(0, error);
        if (!error.empty())
            throw std::runtime_error(error);
        share(bytes);
        if (rank_ != 0) {
            const std::byte* at = bytes.data();
            arraysOf(value, [&](auto&... arrays) { (unpack(at, arrays), ...); });
        }
        return value;
    }

private:
    // Integers in the order of the floats.
    static std::int64_t inOrder(float value)
    {
        std::int32_t bits = 0;
        std::memcpy(&bits, &value, sizeof bits);
        return bits < 0 ? bits ^ 0x7fffffff : bits;
    }
    static float ofOrder(std::int64_t number)
    {
        const auto bits = static_cast<std::int32_t>(number < 0 ? number ^ 0x7fffffff : number);
        float value = 0;
        std::memcpy(&value, &bits, sizeof value);
        return value;
    }

    static std::string textOf(const std::exception& e)
    {
        return std::string(e.what()).empty() ? "loading failed" : e.what();
    }

    std::string textOfRank(std::size_t rank, const std::string& own) const
    {
        const auto* first = reinterpret_cast<const std::byte*>(own.data());
        const Bytes text = gather_(Bytes(first, first + own.size()))[rank];
        return std::string(reinterpret_cast<const char*>(text.data()), text.size());
    }

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
    Reduce least_;
    Gather gather_;
    std::shared_ptr<std::uint64_t> bytesRead_ = std::make_shared<std::uint64_t>(0);
};

} // namespace example
