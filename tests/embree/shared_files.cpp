// Meshes and spheres that ranks read together: each rank reads and keeps a share. Bricks are the same, bit for bit, as
// when a single rank reads everything. Ranks are threads.
#include "support.hpp"
#include "together.hpp"

#include <brick_exchange.hpp>
#include <content_cut.hpp>
#include <scene_files.hpp>

#include <algorithm>
#include <cstring>
#include <map>
#include <random>
#include <string>
#include <vector>

namespace shared_files_cases {

using namespace example;
using test::contains;
using test::errorOf;
using test::ofRanks;

namespace {

struct Grid { // a bumpy sheet, whose vertices are in random order where `isShuffled`
    int side = 0;
    bool isShuffled = false;
    std::vector<Vec3> positions;
    std::vector<std::array<std::uint32_t, 4>> quads;

    Grid(int n, bool shuffled) : side(n), isShuffled(shuffled)
    {
        std::mt19937 random(7);
        std::vector<std::uint32_t> order;
        for (std::uint32_t i = 0; i < static_cast<std::uint32_t>(n * n); ++i)
            order.push_back(i);
        if (shuffled)
            std::shuffle(order.begin(), order.end(), random);
        positions.resize(order.size());
        for (int y = 0; y < n; ++y)
            for (int x = 0; x < n; ++x)
                positions[order[static_cast<std::size_t>(y * n + x)]] = {static_cast<float>(x), static_cast<float>(y),
                                                                         static_cast<float>(random() % 1000) / 500};
        const auto at = [&](int x, int y) { return order[static_cast<std::size_t>(y * n + x)]; };
        for (int y = 0; y + 1 < n; ++y)
            for (int x = 0; x + 1 < n; ++x)
                quads.push_back({at(x, y), at(x + 1, y), at(x + 1, y + 1), at(x, y + 1)});
    }
};

template <class T>
void put(std::string& bytes, T value, bool isBig)
{
    char one[sizeof value];
    std::memcpy(one, &value, sizeof value);
    if (isBig)
        std::reverse(one, one + sizeof value);
    bytes.append(one, sizeof value);
}

enum class Faces { Triangles, Quads, Both };

// The faces of the grid: two triangles for each quad, the quad itself, or each in turn.
std::vector<std::vector<std::uint32_t>> facesOf(const Grid& grid, Faces faces)
{
    std::vector<std::vector<std::uint32_t>> all;
    for (std::size_t i = 0; i < grid.quads.size(); ++i) {
        const auto& q = grid.quads[i];
        if (faces == Faces::Quads || (faces == Faces::Both && i % 2 == 0)) {
            all.push_back({q.begin(), q.end()});
        } else {
            all.push_back({q[0], q[1], q[2]});
            all.push_back({q[0], q[2], q[3]});
        }
    }
    return all;
}

std::string text(float value)
{
    char digits[32];
    std::snprintf(digits, sizeof digits, "%.9g", static_cast<double>(value));
    return digits;
}

std::string plyOf(const Grid& grid, Faces faces, const std::string& format, bool hasColors)
{
    const auto all = facesOf(grid, faces);
    std::string bytes = "ply\nformat " + format + " 1.0\nelement vertex " + std::to_string(grid.positions.size())
                        + "\nproperty float x\nproperty float y\nproperty float z\n"
                        + (hasColors ? "property uchar red\nproperty uchar green\nproperty uchar blue\n" : "")
                        + "element face " + std::to_string(all.size())
                        + "\nproperty uchar flag\nproperty list uchar int vertex_indices\nend_header\n";
    const bool isAscii = format == "ascii", isBig = contains(format, "big");
    for (std::size_t i = 0; i < grid.positions.size(); ++i) {
        const Vec3& p = grid.positions[i];
        const std::uint8_t red = static_cast<std::uint8_t>(i % 256), green = static_cast<std::uint8_t>(i / 7 % 256);
        if (isAscii) {
            bytes += text(p.x) + ' ' + text(p.y) + ' ' + text(p.z);
            bytes += hasColors ? ' ' + std::to_string(red) + ' ' + std::to_string(green) + " 9\n" : "\n";
        } else {
            for (int axis = 0; axis < 3; ++axis)
                put(bytes, component(p, axis), isBig);
            if (hasColors)
                bytes += {static_cast<char>(red), static_cast<char>(green), '\t'};
        }
    }
    for (const auto& face : all) {
        if (isAscii) {
            bytes += "1 " + std::to_string(face.size());
            for (const std::uint32_t index : face)
                bytes += ' ' + std::to_string(index);
            bytes += '\n';
        } else {
            bytes += {'\1', static_cast<char>(face.size())};
            for (const std::uint32_t index : face)
                put(bytes, index, isBig);
        }
    }
    return bytes;
}

// An OBJ file with positive and negative indices, and with vertices between the faces.
std::string objOf(const Grid& grid, Faces faces, bool hasColors)
{
    std::string bytes = "# a sheet\r\n";
    std::size_t written = 0;
    for (const auto& face : facesOf(grid, faces)) {
        const std::size_t need = *std::max_element(face.begin(), face.end());
        for (; written <= need; ++written) {
            const Vec3& p = grid.positions[written];
            bytes +=
                "v " + text(p.x) + ' ' + text(p.y) + ' ' + text(p.z) + (hasColors ? " .25 .5 1\n" : "\nvn 0 0 1\n");
        }
        bytes += 'f';
        for (std::size_t i = 0; i < face.size(); ++i)
            bytes += ' '
                     + (i % 2 == 0 ? std::to_string(face[i] + 1) + "//1"
                                   : std::to_string(static_cast<long>(face[i]) - static_cast<long>(written)));
        bytes += '\n';
    }
    return bytes;
}

std::string xyzOf(int count, int frames, bool isExtended)
{
    std::string bytes;
    const char* elements[] = {"C", "O", "Qq", "Zz", "n"};
    for (int frame = 0; frame < frames; ++frame) {
        bytes += std::to_string(count) + (isExtended ? "\nProperties=pos:R:3:species:S:1\n" : "\na comment\n");
        for (int i = 0; i < count; ++i) {
            const std::string place = std::to_string(i % 101) + ".5 " + std::to_string(i * 7 % 89) + ' '
                                      + std::to_string(frame * 50 + i % 13);
            const char* element = elements[i % 5];
            bytes += isExtended ? place + ' ' + element + " 1 2\n" : element + (' ' + place) + '\n';
        }
        bytes += frame + 1 < frames ? "\n" : "";
    }
    return bytes;
}

// All values of each primitive, by the primitive's number.
using Primitives = std::map<std::uint32_t, std::vector<float>>;

void add(Primitives& all, const std::vector<BrickMesh>& meshes, const std::vector<BrickSpheres>& spheres)
{
    for (const BrickMesh& part : meshes)
        for (std::size_t i = 0; i < part.primitives.size(); ++i)
            for (const std::uint32_t index : part.mesh.triangles[i]) {
                std::vector<float>& of = all[part.primitives[i]];
                const Vec3 color = part.mesh.colors.empty() ? part.color : part.mesh.colors[index];
                for (const Vec3& v : {part.mesh.positions[index], part.normals[index], color})
                    of.insert(of.end(), {v.x, v.y, v.z});
            }
    for (const BrickSpheres& part : spheres)
        for (std::size_t i = 0; i < part.primitives.size(); ++i) {
            const Sphere& s = part.spheres[i];
            all[part.primitives[i]] = {s.center.x, s.center.y, s.center.z, s.radius, s.color.x, s.color.y, s.color.z};
        }
}

std::vector<Box> cellsOf(const Scene& scene, const Loaders& loaders)
{
    RenderSettings settings;
    settings.width = settings.height = 64;
    return ContentCut(scene, SceneInfo(scene), settings, loaders).cells(3);
}

// Checks that all ranks have the bricks that a single rank has, and that none has read much more than its share.
void check(const std::string& file, int frame, bool isShared)
{
    INFO(file);
    const std::uint64_t size = std::filesystem::file_size(file);
    Scene alone;
    addFile(alone, file, true, frame);
    const std::vector<Box> cells = cellsOf(alone, {});
    const float ghosts = 0.02f;
    std::vector<Primitives> bricks;
    for (const Box& cell : cells) {
        const Brick brick = loadBrick(alone, cell, ghosts);
        bricks.emplace_back();
        add(bricks.back(), brick.meshes, brick.spheres);
    }
    for (const int ranks : {2, 3, 5}) {
        INFO(ranks << " ranks");
        const auto results = ofRanks<std::string>(ranks, [&](const Loaders& loaders) {
            std::string wrong; // reported at the end, as the others wait for this rank
            Scene scene;
            addFile(scene, file, true, frame, loaders);
            const std::uint64_t most = size + (isShared ? size / static_cast<std::uint64_t>(ranks) : size);
            if (loaders.bytesRead() > (isShared ? most - size : most) + 12000)
                wrong += "read " + std::to_string(loaders.bytesRead()) + " of " + std::to_string(size) + "; ";
            std::size_t kept = 0;
            for (const MeshObject& object : scene.meshes)
                kept += object.mesh.triangles.size();
            for (const SphereObject& object : scene.spheres)
                kept += object.spheres.size();
            const std::size_t all = static_cast<std::size_t>(loaders.beginsOf(kept).back());
            if (isShared && kept > all / static_cast<std::size_t>(ranks) * 3 / 2 + 10)
                wrong += "keeps " + std::to_string(kept) + " of " + std::to_string(all) + "; ";
            if (!(scene.bounds == alone.bounds))
                wrong += "other bounds; ";
            if (!(scene.focus().box == alone.focus().box && scene.focus().radius == alone.focus().radius))
                wrong += "another focus; ";
            if (scene.notes != alone.notes)
                wrong += "other notes; ";
            if (ranks == 3 && !(cellsOf(scene, loaders) == cells)) // takes longest
                wrong += "other cells; ";
            std::vector<Box> reaches;
            for (const Box& cell : cells)
                reaches.push_back(reachOf(scene, cell, ghosts));
            for (const int copies : {ranks == 3 ? 2 : 1, ranks}) {
                std::vector<Holders> holders;
                for (int cell = 0; cell < 3; ++cell)
                    holders.push_back({cell % ranks, copies});
                Scene read = scene; // its parts are removed
                const auto surfaces = exchangeBricks(read, holders, reaches, loaders);
                for (std::size_t cell = 0; cell < 3; ++cell) {
                    const bool isHeld = (loaders.rank() - holders[cell].first + ranks) % ranks < copies;
                    Primitives own;
                    add(own, surfaces[cell].meshes, surfaces[cell].spheres);
                    if (own != (isHeld ? bricks[cell] : Primitives()))
                        wrong += "another brick " + std::to_string(cell) + "; ";
                    for (const BrickMesh& part : surfaces[cell].meshes)
                        if (!std::is_sorted(part.primitives.begin(), part.primitives.end()))
                            wrong += "another order; ";
                }
            }
            return wrong;
        });
        for (const std::string& result : results)
            CHECK(result == "");
    }
}

} // namespace

TEST_CASE("Ranks that read a mesh together have the bricks that one alone has", "[shared_files]")
{
    const test::TemporaryFolder folder;
    for (const bool isShuffled : {false, true}) {
        const Grid grid(50, isShuffled);
        for (const std::string format : {"ascii", "binary_little_endian", "binary_big_endian"})
            for (const Faces faces : {Faces::Triangles, Faces::Quads, Faces::Both})
                check(folder.write("a_" + format + ".ply", plyOf(grid, faces, format, faces == Faces::Triangles)), 0,
                      format == "ascii" || faces != Faces::Both);
        check(folder.write("a.obj", objOf(grid, Faces::Both, isShuffled)), 0, true);
    }
}

TEST_CASE("Ranks that read atoms together have the bricks that one alone has", "[shared_files]")
{
    const test::TemporaryFolder folder;
    for (const bool isExtended : {false, true})
        for (const int frames : {1, 3}) {
            const std::string file = folder.write("a.xyz", xyzOf(4000, frames, isExtended));
            for (int frame = 0; frame <= frames; ++frame) {
                INFO("frame " << frame);
                // Other frames are read as well, but not kept.
                check(file, frame, frames == 1);
            }
        }
}

TEST_CASE("Small and odd files are what they are for one rank", "[shared_files]")
{
    const test::TemporaryFolder folder;
    const std::string head = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n",
                      face = "element face 1\nproperty list uchar int vertex_indices\n";
    const auto ply = [&](const std::string& elements, const std::string& rows) {
        return "ply\nformat ascii 1.0\n" + elements + "end_header\n" + rows;
    };
    const std::string triangle = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    for (const auto& [name, bytes] : std::vector<std::pair<std::string, std::string>>{
             {"small.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3"},
             {"mac.obj", "v 0 0 0\rv 1 0 0\rv 0 1 0\rf 1 2 3\r"},
             {"some_colors.obj", "v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"},
             {"no_colors.obj", "v 0 0 0 1 0 7\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n"},
             {"small.ply", ply(head + face, triangle)},
             {"one_line.ply", ply(head + face, "0 0 0 1 0 0 0 1 0 3 0 1 2")},
             {"empty_lines.ply", ply(head + face, "\n0 0 0\n\n1 0 0\n  \n0 1 0\n3 0 1 2\n\n")},
             {"more.ply", ply("element nothing 5\n" + head + "element edge 2\nproperty int a\n" + face
                                  + "element tail 1\nproperty list uchar int b\n",
                              "0 0 0\n1 0 0\n0 1 0\n7\n8\n3 0 1 2\n2 5 6\n")},
             {"face_colors.ply", ply(head + face + "property uchar red\n", "0 0 0\n1 0 0\n0 1 0\n3 0 1 2 9\n")},
             {"one.xyz", "1\n\nC 0 0 0"},
             {"mac.xyz", "2\r\rC 0 0 0\rC 1 2 3\r"},
             {"end.xyz", "2\n\nC 0 0 0\nC 1 2 3\n\n \n\n"},
             {"long.xyz", "2\n" + std::string(3000000, 'x') + "\nC 0 0 0\nC 1 2 3\n"}})
        check(folder.write(name, bytes), 0, false);
}

TEST_CASE("A bad file that ranks read together is the error of one rank alone", "[shared_files]")
{
    const test::TemporaryFolder folder;
    const Grid grid(40, false);
    const std::string ascii = plyOf(grid, Faces::Triangles, "ascii", false),
                      binary = plyOf(grid, Faces::Triangles, "binary_little_endian", false),
                      obj = objOf(grid, Faces::Triangles, false), xyz = xyzOf(1000, 2, false);
    const auto with = [](std::string text, std::size_t from, const std::string& bytes) {
        return text.replace(text.find('\n', from) + 1, bytes.size(), bytes);
    };
    std::string outside = binary;
    outside.replace(outside.size() - 30, 4, "\xff\xff\xff\x7f", 4);
    for (const auto& [name, bytes] : std::vector<std::pair<std::string, std::string>>{
             {"cut.ply", ascii.substr(0, ascii.size() / 2)},
             {"more.ply", ascii + "1 2 3\n"},
             {"word.ply", with(ascii, ascii.size() / 3, "word ")},
             {"index.ply", with(ascii, ascii.size() - 900, "1 3 0 1 99999")},
             {"cut_b.ply", binary.substr(0, binary.size() - 100)},
             {"more_b.ply", binary + "x"},
             {"index_b.ply", outside},
             {"no_header.ply", std::string(5000, 'p')},
             {"huge.ply",
              "ply\nformat binary_little_endian 1.0\nelement vertex 18446744073709551615\nproperty float x\n"
              "property float y\nproperty float z\nelement face 1\n"
              "property list uchar int vertex_indices\nend_header\n"
                  + std::string(400, '\1')},
             {"no_faces.ply",
              "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
              "property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
                  + std::string(36, '\1')},
             {"empty.ply", ""},
             {"word.obj", with(obj, obj.size() / 2, "v 1 word 3\n")},
             {"index.obj", with(obj, obj.size() / 2, "f 1 2 99999\n")},
             {"no_faces.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"},
             {"empty.obj", ""},
             {"word.xyz", with(xyz, xyz.size() / 4, "C x ")},
             {"cut.xyz", xyz.substr(0, xyz.size() / 3)},
             {"other.xyz", "1\n\nC 0 0 0\nwords\n"},
             {"many.xyz", "99999999\n\nC 0 0 0\n"},
             {"bad_comment.xyz", "1\nProperties=pos:R:3\nC 0 0 0\n"},
             {"empty.xyz", ""}}) {
        const std::string file = folder.write(name, bytes);
        INFO(name);
        const auto load = [&](const Loaders& loaders) {
            return errorOf([&] {
                Scene scene;
                addFile(scene, file, true, 0, loaders);
            });
        };
        const std::string alone = load({});
        CHECK(alone.compare(0, file.size() + 2, file + ": ") == 0);
        for (const int ranks : {2, 3, 7})
            for (const std::string& error : ofRanks<std::string>(ranks, load))
                CHECK(error == alone);
    }
}

} // namespace shared_files_cases
