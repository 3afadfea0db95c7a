// Elements: radius and colour of an atom by its symbol or number.
#pragma once

#include "vec.hpp"

#include <array>
#include <cmath>
#include <cstddef>
#include <string_view>

namespace example {
namespace detail {

// By atomic number, from 1. The van der Waals radius in Angstrom is that of Bondi (1964), or, for main-group elements
// that he does not list, of Mantina et al. (2009); 0: neither lists it.
struct Element {
    const char* symbol;
    float radius;
};
inline constexpr std::array<Element, 118> elements{
    {{"H", 1.20f},  {"He", 1.40f}, {"Li", 1.82f}, {"Be", 1.53f}, {"B", 1.92f},  {"C", 1.70f},  {"N", 1.55f},
     {"O", 1.52f},  {"F", 1.47f},  {"Ne", 1.54f}, {"Na", 2.27f}, {"Mg", 1.73f}, {"Al", 1.84f}, {"Si", 2.10f},
     {"P", 1.80f},  {"S", 1.80f},  {"Cl", 1.75f}, {"Ar", 1.88f}, {"K", 2.75f},  {"Ca", 2.31f}, {"Sc", 0},
     {"Ti", 0},     {"V", 0},      {"Cr", 0},     {"Mn", 0},     {"Fe", 0},     {"Co", 0},     {"Ni", 1.63f},
     {"Cu", 1.40f}, {"Zn", 1.39f}, {"Ga", 1.87f}, {"Ge", 2.11f}, {"As", 1.85f}, {"Se", 1.90f}, {"Br", 1.85f},
     {"Kr", 2.02f}, {"Rb", 3.03f}, {"Sr", 2.49f}, {"Y", 0},      {"Zr", 0},     {"Nb", 0},     {"Mo", 0},
     {"Tc", 0},     {"Ru", 0},     {"Rh", 0},     {"Pd", 1.63f}, {"Ag", 1.72f}, {"Cd", 1.58f}, {"In", 1.93f},
     {"Sn", 2.17f}, {"Sb", 2.06f}, {"Te", 2.06f}, {"I", 1.98f},  {"Xe", 2.16f}, {"Cs", 3.43f}, {"Ba", 2.68f},
     {"La", 0},     {"Ce", 0},     {"Pr", 0},     {"Nd", 0},     {"Pm", 0},     {"Sm", 0},     {"Eu", 0},
     {"Gd", 0},     {"Tb", 0},     {"Dy", 0},     {"Ho", 0},     {"Er", 0},     {"Tm", 0},     {"Yb", 0},
     {"Lu", 0},     {"Hf", 0},     {"Ta", 0},     {"W", 0},      {"Re", 0},     {"Os", 0},     {"Ir", 0},
     {"Pt", 1.75f}, {"Au", 1.66f}, {"Hg", 1.55f}, {"Tl", 1.96f}, {"Pb", 2.02f}, {"Bi", 2.07f}, {"Po", 1.97f},
     {"At", 2.02f}, {"Rn", 2.20f}, {"Fr", 3.48f}, {"Ra", 2.83f}, {"Ac", 0},     {"Th", 0},     {"Pa", 0},
     {"U", 1.86f},  {"Np", 0},     {"Pu", 0},     {"Am", 0},     {"Cm", 0},     {"Bk", 0},     {"Cf", 0},
     {"Es", 0},     {"Fm", 0},     {"Md", 0},     {"No", 0},     {"Lr", 0},     {"Rf", 0},     {"Db", 0},
     {"Sg", 0},     {"Bh", 0},     {"Hs", 0},     {"Mt", 0},     {"Ds", 0},     {"Rg", 0},     {"Cn", 0},
     {"Nh", 0},     {"Fl", 0},     {"Mc", 0},     {"Lv", 0},     {"Ts", 0},     {"Og", 0}}};

} // namespace detail

// The atomic number of an element, from its symbol in upper or lower case or from its number; 0 if it is no element.
inline int elementNumber(std::string_view word)
{
    if (word.empty() || word.size() > 3)
        return 0;
    int number = 0;
    for (const char c : word)
        number = c >= '0' && c <= '9' && number >= 0 ? 10 * number + (c - '0') : -1;
    if (number >= 0)
        return number <= static_cast<int>(detail::elements.size()) ? number : 0;
    // A table indexed by two letters, because files have millions of atoms.
    const auto letter = [](char c) {
        return c >= 'a' && c <= 'z' ? c - 'a' + 1 : c >= 'A' && c <= 'Z' ? c - 'A' + 1 : c == '\0' ? 0 : -1;
    };
    const auto place = [&letter](char a, char b) {
        return letter(a) > 0 && letter(b) >= 0 ? 27 * letter(a) + letter(b) : 0;
    };
    static const std::array<int, 27 * 27> numbers = [&place] {
        std::array<int, 27 * 27> all{};
        for (std::size_t i = 0; i < detail::elements.size(); ++i)
            all[static_cast<std::size_t>(place(detail::elements[i].symbol[0], detail::elements[i].symbol[1]))] =
                static_cast<int>(i) + 1;
        for (const char hydrogen : {'D', 'T'}) // its isotopes
            all[static_cast<std::size_t>(place(hydrogen, '\0'))] = 1;
        return all;
    }();
    return word.size() > 2 ? 0 : numbers[static_cast<std::size_t>(place(word[0], word.size() > 1 ? word[1] : '\0'))];
}

// In Angstrom: 2 where it is not known; for words that are no element, that of carbon.
inline float atomRadius(int element)
{
    if (element < 1 || element > static_cast<int>(detail::elements.size()))
        return 1.7f;
    const float radius = detail::elements[static_cast<std::size_t>(element) - 1].radius;
    return radius > 0 ? radius : 2.0f;
}

// Linear RGB. Common elements are near their usual colour (Corey, Pauling, Koltun). Each other element has a colour
// that differs from those of its neighbours in the periodic table.
inline Vec3 atomColor(int element)
{
    struct Entry {
        int element;
        Vec3 color;
    };
    static const Entry usual[] = {{1, {0.80f, 0.80f, 0.80f}},  {6, {0.26f, 0.46f, 0.44f}},  {7, {0.10f, 0.24f, 0.62f}},
                                  {8, {0.72f, 0.24f, 0.14f}},  {9, {0.30f, 0.72f, 0.12f}},  {11, {0.36f, 0.12f, 0.78f}},
                                  {12, {0.14f, 0.50f, 0.04f}}, {14, {0.80f, 0.58f, 0.34f}}, {15, {0.85f, 0.30f, 0.03f}},
                                  {16, {0.85f, 0.62f, 0.05f}}, {17, {0.08f, 0.65f, 0.08f}}, {19, {0.26f, 0.05f, 0.55f}},
                                  {20, {0.10f, 0.62f, 0.18f}}, {26, {0.70f, 0.16f, 0.04f}}, {29, {0.58f, 0.22f, 0.06f}},
                                  {30, {0.20f, 0.22f, 0.44f}}, {35, {0.36f, 0.03f, 0.03f}}, {53, {0.28f, 0.01f, 0.28f}},
                                  {79, {0.80f, 0.50f, 0.04f}}};
    if (element < 1)
        return {0.55f, 0.20f, 0.50f};
    for (const Entry& entry : usual)
        if (entry.element == element)
            return entry.color;
    const double turn = 0.618033988749895 * element; // by the golden ratio: no two are close
    const auto channel = [turn](double shift) {
        return static_cast<float>(0.35 + 0.3 * std::cos(2 * 3.14159265358979323846 * (turn + shift)));
    };
    return {channel(0), channel(1.0 / 3), channel(2.0 / 3)};
}

} // namespace example
