// The readers of dfb_render: an accepted file is a mesh, atoms or a volume that the renderer can use, and is the same
// when it is written and read once more. A refused file gives a std::runtime_error that begins with the file's name.
//
// An input: a byte that picks the reader and the frame, then the file. Before the bytes of a volume without header
// comes its name, up to a line break. A volume with a header has header and voxels in one file.
#include "fuzz.hpp"

#include <bricks.hpp>
#include <obj.hpp>
#include <ply.hpp>
#include <xyz.hpp>

#include <cmath>
#include <sstream>
#include <stdexcept>

namespace {

using namespace example;

enum Reader : std::uint8_t { Ply, Obj, Xyz, Raw, Nrrd, Meta, readers };
const std::string name = "the.file";

std::string textOf(float value)
{
    char digits[32];
    const auto result = std::to_chars(digits, digits + sizeof digits, value);
    return std::string(digits, result.ptr);
}

std::string plyOf(const Mesh& mesh)
{
    std::string text = "ply\nformat ascii 1.0\nelement vertex " + std::to_string(mesh.positions.size())
                       + "\nproperty float x\nproperty float y\nproperty float z\nelement face "
                       + std::to_string(mesh.triangles.size())
                       + "\nproperty list uchar uint vertex_indices\nend_header\n";
    for (const Vec3& p : mesh.positions)
        text += textOf(p.x) + ' ' + textOf(p.y) + ' ' + textOf(p.z) + '\n';
    for (const Triangle& t : mesh.triangles)
        text += "3 " + std::to_string(t[0]) + ' ' + std::to_string(t[1]) + ' ' + std::to_string(t[2]) + '\n';
    return text;
}

bool areSame(const Vec3& a, const Vec3& b) { return a.x == b.x && a.y == b.y && a.z == b.z; }

bool isFinite(const Vec3& p) { return std::isfinite(p.x) && std::isfinite(p.y) && std::isfinite(p.z); }

// What a rank does with the object before it renders.
template <class Object>
Scene sceneWith(const Object& object)
{
    Scene scene;
    scene.add(object, true);
    fuzz::require(isFinite(scene.bounds.lo) && isFinite(scene.bounds.hi), "the bounds of the scene are finite");
    const Focus focus = scene.focus();
    fuzz::require(isFinite(focus.box.lo) && isFinite(focus.box.hi) && std::isfinite(focus.radius),
                  "what there is to see is finite");
    return scene;
}

void checkMesh(const Mesh& mesh)
{
    fuzz::require(!mesh.triangles.empty(), "a mesh has triangles");
    for (const Vec3& p : mesh.positions)
        fuzz::require(isUsable(p), "coordinates are usable");
    for (const Triangle& t : mesh.triangles)
        for (const std::uint32_t index : t)
            fuzz::require(index < mesh.positions.size(), "indices are of vertices");
    fuzz::require(mesh.colors.empty() || mesh.colors.size() == mesh.positions.size(),
                  "all vertices have a colour or none");
    for (const Vec3& c : mesh.colors)
        for (int i = 0; i < 3; ++i)
            fuzz::require(component(c, i) >= 0 && component(c, i) <= 1, "a colour is one");
    const Mesh again = parsePly(plyOf(mesh), name);
    bool same = again.positions.size() == mesh.positions.size() && again.triangles == mesh.triangles;
    for (std::size_t i = 0; i < mesh.positions.size() && same; ++i)
        same = areSame(mesh.positions[i], again.positions[i]);
    fuzz::require(same, "a mesh comes back");

    const Scene scene = sceneWith(mesh);
    std::vector<bool> seen(mesh.triangles.size());
    for (const Box& cell : cutScene(scene, 3)) {
        const Brick brick = loadBrick(scene, cell);
        for (const BrickMesh& part : brick.meshes)
            for (const std::uint32_t primitive : part.primitives)
                seen.at(primitive) = true;
    }
    fuzz::require(std::find(seen.begin(), seen.end(), false) == seen.end(), "each triangle is in a brick");
}

void checkSpheres(const std::vector<Sphere>& spheres)
{
    fuzz::require(!spheres.empty(), "there are atoms");
    std::string text = std::to_string(spheres.size()) + "\n\n";
    for (const Sphere& s : spheres) {
        fuzz::require(isUsable(s.center) && s.radius > 0, "an atom is usable");
        for (int i = 0; i < 3; ++i)
            fuzz::require(component(s.color, i) >= 0 && component(s.color, i) <= 1, "its colour is one");
        text += "C " + textOf(s.center.x) + ' ' + textOf(s.center.y) + ' ' + textOf(s.center.z) + '\n';
    }
    const auto again = parseXyz(text, name);
    bool same = again.size() == spheres.size();
    for (std::size_t i = 0; i < spheres.size() && same; ++i)
        same = areSame(spheres[i].center, again[i].center);
    fuzz::require(same, "atoms come back");
    sceneWith(spheres);
}

void useVolume(VolumeSource& source, const VolumeFile& file, const std::string& bytes)
{
    const VolumeInfo& info = source.info;
    const Index3& d = info.dims;
    fuzz::require(d[0] >= 2 && d[1] >= 2 && d[2] >= 2
                      && static_cast<std::size_t>(d[0]) * static_cast<std::size_t>(d[1])
                                 * static_cast<std::size_t>(d[2]) * file.format.bytes()
                             == bytes.size() - static_cast<std::size_t>(file.begin),
                  "a volume has as many voxels as its name says");
    fuzz::require(std::isfinite(info.minimum) && std::isfinite(info.maximum) && info.minimum < info.maximum,
                  "the range of a volume is finite and not empty");
    source.open = [&] { return boxReader(std::make_shared<std::istringstream>(bytes), file, info); };
    const VoxelBlock block(source, {-1, -1, -1}, {d[0] + 2, d[1] + 2, d[2] + 2});
    for (int z = -1; z < d[2] + 2; ++z)
        for (int x = -1; x < d[0] + 2; ++x)
            fuzz::require(info.type != VoxelType::Float32 || std::isfinite(block.data<float>()[block.index(x, 0, z)]),
                          "voxels are finite");
    try {
        sceneWith(source);
    } catch (const std::runtime_error&) { // the spacing is too fine for floats
        fuzz::require(info.spacing.x != info.spacing.y || info.spacing.x != info.spacing.z,
                      "cubic voxels can be told apart");
    }
}

void checkVolume(const std::string& bytes)
{
    const std::size_t end = std::min(bytes.find('\n'), bytes.size());
    const std::string file = bytes.substr(0, end), voxels = bytes.substr(std::min(end + 1, bytes.size()));
    if (file.find('\0') != std::string::npos)
        return; // no path can contain it
    VolumeSource source;
    VolumeFile described;
    try {
        described = parseVolumeName(file);
        source.info = describeVolume(std::make_shared<std::istringstream>(voxels), described);
    } catch (const std::runtime_error& e) {
        fuzz::require(std::string(e.what()).compare(0, file.size() + 2, file + ": ") == 0, "the error names the file");
        return;
    }
    useVolume(source, described, voxels);
}

// Checks a header. Its voxels follow it, or are in another file, which is not opened.
void checkHeader(const std::string& bytes, VolumeFile (*parse)(std::istream&, const std::string&))
{
    VolumeSource source;
    VolumeFile described;
    try {
        std::istringstream stream(bytes);
        described = parse(stream, name);
        fuzz::require(isUsable(described.spacing) && described.spacing.x > 0, "a spacing is usable");
        if (described.data != name)
            return;
        source.info = describeVolume(std::make_shared<std::istringstream>(bytes), described);
    } catch (const std::runtime_error& e) {
        fuzz::require(std::string(e.what()).compare(0, name.size() + 2, name + ": ") == 0, "the error names the file");
        return;
    }
    source.name = name;
    for (const std::string& note : described.notes)
        fuzz::require(note.compare(0, name.size() + 2, name + ": ") == 0, "a note names the file");
    useVolume(source, described, bytes);
}

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    fuzz::Input in(data, size);
    const int pick = in.take<std::uint8_t>(), reader = pick % readers, frame = pick / readers % 4;
    const std::string bytes = in.rest();
    if (reader == Raw)
        checkVolume(bytes);
    else if (reader == Nrrd || reader == Meta)
        checkHeader(bytes, reader == Nrrd ? parseNrrd : parseMetaImage);
    if (reader >= Raw)
        return 0;
    std::vector<Sphere> spheres;
    Mesh mesh;
    Notes notes;
    try {
        if (reader == Ply)
            mesh = parsePly(bytes, name, &notes);
        else if (reader == Obj)
            mesh = parseObj(bytes, name, &notes);
        else
            spheres = parseXyz(bytes, name, frame, &notes);
    } catch (const std::runtime_error& e) {
        fuzz::require(std::string(e.what()).compare(0, name.size() + 2, name + ": ") == 0, "the error names the file");
        return 0;
    }
    for (const std::string& note : notes)
        fuzz::require(note.compare(0, name.size() + 2, name + ": ") == 0, "a note names the file");
    if (reader == Xyz)
        checkSpheres(spheres);
    else
        checkMesh(mesh);
    return 0;
}

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    std::vector<std::pair<std::string, std::string>> all;
    const auto add = [&](const std::string& seed, Reader reader, const std::string& bytes) {
        all.emplace_back(seed, Output().put(reader).text(bytes).bytes());
    };
    const auto header = [](const std::string& format, const std::string& elements) {
        return "ply\nformat " + format + " 1.0\ncomment none\n" + elements + "end_header\n";
    };
    const std::string plain = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
                              "element face 2\nproperty list uchar int vertex_indices\n";
    add("ply_ascii", Ply, header("ascii", plain) + "0 0 0\n1 0 0\n1 1 0\n0 1 -2.5\n4 0 1 2 3\n3 3 1 0\n");
    Output little, big;
    for (const float c : {0.f, 0.f, 0.f, 1.f, 0.f, 0.f, 1.f, 1.f, 0.f, 0.f, 1.f, -2.5f})
        little.put(c);
    little.put(std::uint8_t{4}).put(0).put(1).put(2).put(3).put(std::uint8_t{3}).put(3).put(1).put(0);
    add("ply_binary", Ply, header("binary_little_endian", plain) + little.bytes());
    const std::string small = "element vertex 3\nproperty uchar x\nproperty double red\nproperty uchar y\n"
                              "property list ushort short marks\nproperty char z\n"
                              "element face 1\nproperty char flag\nproperty list uchar uchar vertex_index\n";
    for (int i = 0; i < 3; ++i)
        big.put(std::uint8_t(i))
            .put(0.0)
            .put(std::uint8_t(i * i))
            .put(std::uint16_t{0x0100})
            .put(std::int16_t{-1})
            .put(std::int8_t{0});
    big.put(std::int8_t{1}).put(std::uint8_t{3}).put(std::uint8_t{0}).put(std::uint8_t{1}).put(std::uint8_t{2});
    add("ply_big_endian", Ply, header("binary_big_endian", small) + big.bytes());
    add("ply_skipped", Ply,
        header("ascii", "element camera 1\nproperty list ushort short marks\nelement nothing 3\n" + plain
                            + "element tail 2\nproperty int8 t\n")
            + "2 -1 300\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 3 1 0\n1 2\n");
    add("ply_index_not_whole", Ply, header("ascii", plain) + "0 0 0\n1 0 0\n1 1 0\n0 1 -2.5\n4 0 1 2 3\n3 2.5 1 0\n");
    add("obj", Obj,
        "# a comment\no thing\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0.5 +0.25 -2e0 1.0\nvt 0.5 0.5\nvn 0 0 1\n"
        "g part\nusemtl red\nf 1/1/1 2/1/1 3//1 4\nf -1 2 1\n");
    add("obj_line_ends", Obj, "v 0 0 0\rv 1 0 0\rv 1 nan 0\r\nf 1 2 3\r");
    add("obj_large_index", Obj, "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4294967299\n");
    add("obj_index_with_more", Obj, "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3x\n");
    add("xyz", Xyz, "3\nany text\nC 0 0.5 -1\nO\t1e1 2 3\r\nXx 4 5 6");
    add("ply_colors", Ply,
        header("ascii", "element vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n"
                        "property ushort green\nproperty float blue\nelement face 1\n"
                        "property list uchar int vertex_indices\nproperty uchar red\n")
            + "0 0 0 255 65535 1\n1 0 0 128 0 0.5\n+1 1 0 0 0 0\n3 0 1 2 7\n");
    add("obj_colors", Obj, "v 0 0 0 1 0 .5 # red\nv 1 0 0 0 0 1\nv 1 1 0 0 0 0\nf 1 2 3\n");
    add("xyz_extended", Xyz,
        "2\nLattice=\"1 0 0\" Properties=\"pos:R:3:mass:R:1:species:S:1\"\n1 2 3 16 fe 5\n+4 5 6 7 92\n");
    const std::string frames = "1\nfirst\nC 1 0 0\n2\nsecond\nC 2 0 0\nQq 3 0 0\n\n1\nthird\nC 4 0 0\n \n";
    add("xyz_frames", Xyz, frames);
    add("xyz_second_frame", Reader(Xyz + 2 * readers), frames);
    add("raw_uint8", Raw, "a_2x3x4_uint8.raw\n" + std::string(12, 'a') + std::string(12, 'z'));
    Output shorts, floats;
    for (std::uint16_t i = 0; i < 8; ++i)
        shorts.put(static_cast<std::uint16_t>(i * 5000));
    for (const float f : {-3.f, 0.f, std::nanf(""), 5.f, 1e30f, -1e30f, 2.f, 1.f})
        floats.put(f);
    for (const float f : {1e30f, 3e38f})
        add("raw_constant_" + std::to_string(f > 1e35f), Raw,
            "c_2x2x2_float32.raw\n" + Output().put(f).put(f).put(f).put(f).put(f).put(f).put(f).put(f).bytes());
    add("ply_tiny_far", Ply,
        header("ascii", plain) + "0 1e14 0\n1e-38 1e14 0\n1e-38 1e14 0\n0 1e14 0\n4 0 1 2 3\n3 3 1 0\n");
    add("ply_denormal", Ply, header("ascii", plain) + "0 0 0\n1e-42 0 0\n1e-42 1e-41 0\n0 0 0\n4 0 1 2 3\n3 3 1 0\n");
    const std::string nrrd = "NRRD0004\n# a comment\ntype: short\ndimension: 3\nsizes: 2 2 2\nendian: big\n"
                             "encoding: raw\nspace directions: (1,0,0) (0,1,0) (0,0,-2.5)\nspace origin: (1,2,3)\n"
                             "key:=value\n\n";
    add("nrrd", Nrrd, nrrd + "abcdefghijklmnop");
    add("nrrd_detached", Nrrd,
        "NRRD0001\r\ntype: double\r\ndimension: 3\r\nsizes: 2 2 2\r\nendian: little\r\nencoding: raw\r\n"
        "spacings: 1 nan 2\r\nbyte skip: -1\r\ndata file: no.raw\r\n");
    add("meta", Meta,
        "ObjectType = Image\nNDims = 3\nDimSize = 2 2 2\nElementSpacing = 1 1 2\nOffset = 1 2 3\n"
        "TransformMatrix = 1 0 0 0 0 1 0 -1 0\nElementByteOrderMSB = True\nElementType = MET_INT\n"
        "ElementDataFile = LOCAL\nabcdefghijklmnopqrstuvwxyzABCDEF");
    add("raw_uint16", Raw, "a_2x2x2_uint16.raw\n" + shorts.bytes());
    add("raw_float32", Raw, "some/where_2x2x2_float32.raw\n" + floats.bytes());
    return all;
}
