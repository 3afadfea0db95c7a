// MeshShare: a rank's part of a mesh that several ranks have read together, as it is read: a run of the vertices and a
// run of the triangles, whose vertices other ranks may have.
//
// MeshPart: the same triangles with all vertices that they need. normalsOf() gives their normals in the whole mesh.
#pragma once

#include "loaders.hpp"
#include "mesh.hpp"

#include <algorithm>
#include <bitset>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace example {

struct MeshShare {
    Mesh mesh;                               // triangles have vertex numbers of the whole mesh
    std::vector<std::uint64_t> vertexBegins; // where the vertices of each rank begin in the whole mesh, and the end
    std::uint64_t firstTriangle = 0;         // its number in the whole mesh
};

struct MeshPart {
    Mesh mesh;
    std::vector<std::uint32_t> vertices; // the number of each in the whole mesh, ascending
};

// Collective: deals out the mesh of rank 0 in shares. What the other ranks give is ignored.
inline MeshShare dealMesh(Mesh whole, const Loaders& loaders)
{
    const int ranks = loaders.size();
    std::vector<Loaders::Bytes> parts(static_cast<std::size_t>(ranks) + 1);
    const auto begins = [&](std::uint64_t count) {
        std::vector<std::uint64_t> all;
        for (int rank = 0; rank < ranks; ++rank)
            all.push_back(Loaders::shareOf(count, rank, ranks).first);
        all.push_back(count);
        return all;
    };
    loaders.gatherOf<char>([&] {
        const auto vertices = begins(whole.positions.size()), triangles = begins(whole.triangles.size());
        for (std::size_t r = 0; r + 1 < parts.size() && loaders.rank() == 0; ++r) {
            const auto pack = [&](const auto& array, const std::vector<std::uint64_t>& from) {
                using T = typename std::decay_t<decltype(array)>::value_type;
                const bool isThere = !array.empty();
                Loaders::pack(std::vector<T>(array.begin() + static_cast<std::ptrdiff_t>(isThere ? from[r] : 0),
                                             array.begin() + static_cast<std::ptrdiff_t>(isThere ? from[r + 1] : 0)),
                              parts[r]);
            };
            pack(whole.positions, vertices);
            pack(whole.colors, vertices);
            pack(whole.triangles, triangles);
        }
        whole = Mesh();
        return std::vector<char>();
    });
    const std::vector<Loaders::Bytes> received = loaders.exchange(std::move(parts));
    MeshShare share;
    const std::byte* at = received[0].data();
    Loaders::unpack(at, share.mesh.positions);
    Loaders::unpack(at, share.mesh.colors);
    Loaders::unpack(at, share.mesh.triangles);
    share.vertexBegins = loaders.beginsOf(share.mesh.positions.size());
    share.firstTriangle = loaders.beginsOf(share.mesh.triangles.size())[static_cast<std::size_t>(loaders.rank())];
    return share;
}

// The set of vertices that some triangles have, with a bit for each vertex of a range.
class VertexSet {
public:
    explicit VertexSet(const std::vector<Triangle>& triangles)
    {
        std::uint32_t least = ~std::uint32_t{0}, greatest = 0;
        for (const Triangle& triangle : triangles)
            for (const std::uint32_t index : triangle) {
                least = std::min(least, index);
                greatest = std::max(greatest, index);
            }
        if (triangles.empty())
            return;
        first_ = least / 64 * 64;
        words_.resize((greatest - first_) / 64 + 1);
        for (const Triangle& triangle : triangles)
            for (const std::uint32_t index : triangle)
                words_[(index - first_) / 64] |= std::uint64_t{1} << (index % 64);
        std::uint32_t count = 0;
        for (const std::uint64_t word : words_) {
            before_.push_back(count);
            count += countOf(word);
        }
    }

    // How many vertices of the set are before this one.
    std::uint32_t indexOf(std::uint32_t vertex) const
    {
        const std::size_t word = (vertex - first_) / 64;
        return before_[word] + countOf(words_[word] & ((std::uint64_t{1} << (vertex % 64)) - 1));
    }
    // Ascending.
    std::vector<std::uint32_t> list() const
    {
        std::vector<std::uint32_t> all;
        for (std::size_t word = 0; word < words_.size(); ++word)
            for (std::uint32_t bit = 0; bit < 64; ++bit)
                if ((words_[word] >> bit & 1) != 0)
                    all.push_back(first_ + 64 * static_cast<std::uint32_t>(word) + bit);
        return all;
    }

private:
    static std::uint32_t countOf(std::uint64_t word)
    {
        return static_cast<std::uint32_t>(std::bitset<64>(word).count());
    }

    std::uint32_t first_ = 0;
    std::vector<std::uint64_t> words_;
    std::vector<std::uint32_t> before_; // how many are before each word
};

// Asks the ranks that have certain vertices for their values, as often as needed. All members are collective.
class VertexLookup {
public:
    // `wanted`: ascending. `begins`: as MeshShare has them.
    VertexLookup(const std::vector<std::uint32_t>& wanted, const std::vector<std::uint64_t>& begins,
                 const Loaders& loaders)
        : begins_(begins), loaders_(loaders)
    {
        std::vector<Loaders::Bytes> parts(begins.size());
        auto from = wanted.begin();
        for (std::size_t r = 0; r + 1 < begins.size(); ++r) {
            const auto to = std::lower_bound(from, wanted.end(), begins[r + 1]);
            Loaders::pack(std::vector<std::uint32_t>(from, to), parts[r]);
            from = to;
        }
        for (const Loaders::Bytes& bytes : loaders.exchange(std::move(parts))) {
            const std::byte* at = bytes.data();
            asked_.emplace_back();
            Loaders::unpack(at, asked_.back());
        }
    }

    // Returns the values that others have for the vertices that this rank wants. `own`: the values of its own run.
    template <class T>
    std::vector<T> of(const std::vector<T>& own) const
    {
        std::vector<Loaders::Bytes> parts(begins_.size());
        const std::uint64_t first = begins_[static_cast<std::size_t>(loaders_.rank())];
        for (std::size_t r = 0; r < asked_.size(); ++r) {
            std::vector<T> answer;
            answer.reserve(asked_[r].size());
            for (std::size_t i = 0; i < asked_[r].size() && !own.empty(); ++i) // there may be no colours
                answer.push_back(own[static_cast<std::size_t>(asked_[r][i] - first)]);
            Loaders::pack(answer, parts[r]);
        }
        std::vector<T> all;
        for (const Loaders::Bytes& bytes : loaders_.exchange(std::move(parts))) { // by rank, so vertices ascend
            const std::byte* at = bytes.data();
            Loaders::unpack(at, all);
        }
        return all;
    }

private:
    const std::vector<std::uint64_t>& begins_;
    const Loaders& loaders_;
    std::vector<std::vector<std::uint32_t>> asked_; // the vertices that each rank asks this one for
};

// The triangles of a share with their vertices. Collective.
inline MeshPart partOf(MeshShare& share, const VertexLookup& lookup, const VertexSet& vertices)
{
    MeshPart part;
    part.vertices = vertices.list();
    part.mesh.positions = lookup.of(share.mesh.positions);
    part.mesh.colors = lookup.of(share.mesh.colors);
    part.mesh.triangles = std::move(share.mesh.triangles);
    for (Triangle& triangle : part.mesh.triangles)
        for (std::uint32_t& index : triangle)
            index = vertices.indexOf(index);
    return part;
}

// Collective: the normals that vertexNormals() of the whole mesh has for the vertices of a part. They are equal bit for
// bit, because the rank that has a vertex adds its triangles in their order.
inline std::vector<Vec3> normalsOf(const MeshPart& part, const std::vector<std::uint64_t>& begins,
                                   const VertexLookup& lookup, const Loaders& loaders)
{
    const std::size_t ranks = begins.size() - 1, rank = static_cast<std::size_t>(loaders.rank());
    const auto forEachCorner = [&part](const auto& function) { // of the triangles, in order
        for (const Triangle& t : part.mesh.triangles) {
            const Vec3d normal = weightedNormal(part.mesh, t);
            for (const std::uint32_t index : t)
                function(part.vertices[index], normal);
        }
    };
    struct ForOne {
        std::vector<std::uint32_t> vertices;
        std::vector<Vec3d> normals;
    };
    std::vector<ForOne> forOthers(ranks);
    forEachCorner([&](std::uint32_t vertex, const Vec3d& normal) {
        if (vertex >= begins[rank] && vertex < begins[rank + 1])
            return;
        const auto behind = std::upper_bound(begins.begin(), begins.end(), vertex); // right also where a rank has none
        ForOne& other = forOthers[static_cast<std::size_t>(behind - begins.begin()) - 1];
        other.vertices.push_back(vertex);
        other.normals.push_back(normal);
    });
    std::vector<Loaders::Bytes> parts(ranks + 1);
    for (std::size_t r = 0; r < ranks; ++r) {
        Loaders::pack(forOthers[r].vertices, parts[r]);
        Loaders::pack(forOthers[r].normals, parts[r]);
        forOthers[r] = ForOne();
    }
    const std::vector<Loaders::Bytes> received = loaders.exchange(std::move(parts));
    std::vector<NormalSum> sums(static_cast<std::size_t>(begins[rank + 1] - begins[rank]));
    const auto add = [&](std::uint32_t vertex, const Vec3d& normal) {
        sums[static_cast<std::size_t>(vertex - begins[rank])].add(normal);
    };
    for (std::size_t r = 0; r < ranks; ++r) {
        if (r == rank)
            forEachCorner([&](std::uint32_t vertex, const Vec3d& normal) {
                if (vertex >= begins[rank] && vertex < begins[rank + 1])
                    add(vertex, normal);
            });
        const std::byte* at = received[r].data();
        ForOne own;
        Loaders::unpack(at, own.vertices);
        Loaders::unpack(at, own.normals);
        for (std::size_t i = 0; i < own.vertices.size(); ++i)
            add(own.vertices[i], own.normals[i]);
    }
    std::vector<Vec3> normals;
    normals.reserve(sums.size());
    for (const NormalSum& sum : sums)
        normals.push_back(sum.unit());
    return lookup.of(normals);
}

// Collective: gives all ranks equally many of some things, which keep their order; does nothing if the numbers are
// about equal. For ranks that have read equal parts of a text, and may have only vertices, or only triangles. `begins`:
// where the things of each rank begin, and the end.
template <class T>
void evenOut(std::vector<T>& things, const std::vector<std::uint64_t>& begins, const Loaders& loaders)
{
    const std::uint64_t all = begins.back(), ranks = begins.size() - 1;
    bool isEven = true;
    for (std::size_t r = 0; r < ranks; ++r)
        isEven = isEven && begins[r + 1] - begins[r] <= all / ranks + all / (8 * ranks) + 1;
    if (isEven)
        return;
    std::vector<Loaders::Bytes> parts(begins.size());
    const std::uint64_t first = begins[static_cast<std::size_t>(loaders.rank())];
    for (std::size_t r = 0; r < ranks; ++r) {
        const auto [from, to] = Loaders::shareOf(all, static_cast<int>(r), loaders.size());
        const auto at = [&](std::uint64_t i) {
            return things.begin()
                   + static_cast<std::ptrdiff_t>(std::clamp<std::uint64_t>(i, first, first + things.size()) - first);
        };
        Loaders::pack(std::vector<T>(at(from), at(to)), parts[r]);
    }
    things = {};
    for (const Loaders::Bytes& bytes : loaders.exchange(std::move(parts))) {
        const std::byte* at = bytes.data();
        Loaders::unpack(at, things);
    }
}

// Collective: completes a share whose triangles and colours are as each rank has read them. Returns nothing, on all
// ranks, if there are no triangles or too many.
inline std::optional<MeshShare> finished(MeshShare share, const std::string& name, const Loaders& loaders, Notes* notes)
{
    const std::uint64_t most = std::uint64_t{1} << 32;
    const std::vector<std::uint64_t> triangles = loaders.beginsOf(share.mesh.triangles.size());
    if (triangles.back() == 0 || triangles.back() >= most || share.vertexBegins.back() >= most)
        return std::nullopt;
    // Colours are used if all vertices have one.
    std::vector<Vec3>& colors = share.mesh.colors;
    const auto sums = loaders.sumOf(
        {static_cast<std::int64_t>(colors.size()), std::count_if(colors.begin(), colors.end(), detail::isColor)});
    const auto all = static_cast<std::int64_t>(share.vertexBegins.back());
    if (sums[0] > 0 && (sums[0] != all || sums[1] != all))
        colors.assign(1, Vec3{-1, 0, 0}); // not a colour, so all ranks leave colours out
    detail::finishColors(share.mesh, name, notes);
    if (sums[0] == all && sums[1] == all)
        evenOut(colors, share.vertexBegins, loaders);
    evenOut(share.mesh.positions, share.vertexBegins, loaders);
    evenOut(share.mesh.triangles, triangles, loaders);
    share.vertexBegins = loaders.beginsOf(share.mesh.positions.size());
    share.firstTriangle = loaders.beginsOf(share.mesh.triangles.size())[static_cast<std::size_t>(loaders.rank())];
    return share;
}

} // namespace example
