// PlaneFilter: what makes a plane of pixels easier to compress. Neighbouring pixels are alike in the upper bits of each
// word and rarely in the lower ones: so each word becomes its difference to that of the pixel before, small ones of
// either sign with zeros at the top, and the planes of equal bytes are stored one after the other. (The bytes of floats
// as they stand hide from a codec that looks for repetitions what they have in common.)
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>

namespace dfb::detail {

class PlaneFilter {
public:
    // `byteCount` bytes of pixels that have `words` words of `wordBytes` (1, 2 or 4) each; a rest that is no whole
    // pixel is copied.
    static void split(const std::byte* in, std::size_t byteCount, std::size_t wordBytes, std::size_t words,
                      std::byte* out)
    {
        byWord(wordBytes, [&](auto zero) { splitWords(zero, in, byteCount, words, out); });
    }
    // The inverse.
    static void join(const std::byte* in, std::size_t byteCount, std::size_t wordBytes, std::size_t words,
                     std::byte* out)
    {
        byWord(wordBytes, [&](auto zero) { joinWords(zero, in, byteCount, words, out); });
    }

private:
    template <class Call>
    static void byWord(std::size_t wordBytes, const Call& call)
    {
        if (wordBytes == 4)
            call(std::uint32_t{0});
        else if (wordBytes == 2)
            call(std::uint16_t{0});
        else
            call(std::uint8_t{0});
    }

    template <class Word>
    static void splitWords(Word, const std::byte* in, std::size_t byteCount, std::size_t words, std::byte* out)
    {
        constexpr std::size_t size = sizeof(Word);
        constexpr int top = 8 * static_cast<int>(size) - 1;
        const std::size_t pixels = byteCount / (size * words), count = pixels * words;
        for (std::size_t w = 0; w < words; ++w) {
            Word before = 0;
            std::byte* to = out + w * pixels;
            for (std::size_t i = 0; i < pixels; ++i) {
                Word word = 0;
                std::memcpy(&word, in + (i * words + w) * size, size);
                const auto difference = static_cast<Word>(word - before);
                const auto folded =
                    static_cast<Word>(static_cast<Word>(difference << 1)
                                      ^ static_cast<Word>(difference >> top ? Word(~Word{0}) : Word{0}));
                for (std::size_t b = 0; b < size; ++b)
                    to[b * count + i] = static_cast<std::byte>(folded >> (8 * b));
                before = word;
            }
        }
        std::copy_n(in + count * size, byteCount - count * size, out + count * size);
    }

    template <class Word>
    static void joinWords(Word, const std::byte* in, std::size_t byteCount, std::size_t words, std::byte* out)
    {
        constexpr std::size_t size = sizeof(Word);
        const std::size_t pixels = byteCount / (size * words), count = pixels * words;
        for (std::size_t w = 0; w < words; ++w) {
            Word before = 0;
            const std::byte* from = in + w * pixels;
            for (std::size_t i = 0; i < pixels; ++i) {
                Word folded = 0;
                for (std::size_t b = 0; b < size; ++b)
                    folded = static_cast<Word>(folded
                                               | static_cast<Word>(static_cast<Word>(from[b * count + i]) << (8 * b)));
                const auto difference = static_cast<Word>(static_cast<Word>(folded >> 1)
                                                          ^ static_cast<Word>(folded & 1 ? Word(~Word{0}) : Word{0}));
                before = static_cast<Word>(before + difference);
                std::memcpy(out + (i * words + w) * size, &before, size);
            }
        }
        std::copy_n(in + count * size, byteCount - count * size, out + count * size);
    }
};

} // namespace dfb::detail
