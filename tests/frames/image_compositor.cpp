// ImageCompositor: makes one picture of finished images. It is compared with a composition in double that shares no
// code. In one process and over MPI (everywhere.hpp).

#include <dfb/image_compositor.hpp>
#include <dfb/render/shared_world.hpp>

#include "everywhere.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <exception>
#include <limits>
#include <memory>
#include <numeric>
#include <stdexcept>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

namespace frame_cases {

namespace {

constexpr int imageWidth = 150, imageHeight = 93;

std::uint32_t mixed(std::uint32_t a, std::uint32_t b, std::uint32_t c)
{
    std::uint32_t h = a * 0x9e3779b1u ^ (b + 0x7f4a7c15u) * 0x85ebca6bu ^ (c + 0x165667b1u) * 0xc2b2ae35u;
    h = (h ^ h >> 15) * 0x2c1b3c6du;
    h = (h ^ h >> 12) * 0x297a2d39u;
    return h ^ h >> 15;
}

// How an image lies in memory.
struct Form {
    const char* name;
    bool isFloat, bottomUp, isBgra, hasStraightAlpha;
    int padding = 0;     // pixels after each row
    bool isPart = false; // only the valid rectangle lies in memory
};

// What a rank shows at a pixel of the picture, counted from its upper left corner.
struct Source {
    std::array<int, 4> levels{}; // alpha last
    float depth = 1;
};

Source sourceAt(int rank, int x, int y, bool hasStraightAlpha)
{
    const std::uint32_t h =
        mixed(static_cast<std::uint32_t>(rank), static_cast<std::uint32_t>(x), static_cast<std::uint32_t>(y));
    Source s;
    s.levels[3] = h % 4 == 0 ? 255 : static_cast<int>(h >> 8 & 255);
    for (std::uint32_t c = 0; c < 3; ++c) {
        const int value = static_cast<int>(mixed(h, c, 5) & 255);
        s.levels[c] = hasStraightAlpha ? value : std::min(value, s.levels[3]);
    }
    s.depth = h % 3 == 0 ? 1.0f : static_cast<float>(h >> 4 & 63) / 64; // many are equal
    return s;
}

// The valid part of a rank's image, counted from the picture's upper left corner. Ranks differ, and rank 2 has nothing.
dfb::Region validOf(int rank)
{
    const int inset = 9 * rank;
    if (rank == 2)
        return {0, 0, 0, 0};
    return {std::min(inset, 70), std::min(2 * inset, 40), imageWidth - std::min(inset / 2, 30),
            imageHeight - std::min(inset, 33)};
}

bool isIn(const dfb::Region& r, int x, int y) { return x >= r.x0 && x < r.x1 && y >= r.y0 && y < r.y1; }

// A rank's image in memory, surrounded by values that must not be read.
struct OwnImage {
    std::vector<std::uint8_t> bytes;
    std::vector<float> floats, depths;
    dfb::InputImage image;

    OwnImage(int rank, const Form& form, bool hasDepth)
    {
        dfb::Region valid = validOf(rank); // in the image's own row order
        if (form.bottomUp)
            valid = {valid.x0, imageHeight - valid.y1, valid.x1, imageHeight - valid.y0};
        if (valid.width() <= 0)
            return;
        const dfb::Region held = form.isPart ? valid : dfb::Region{0, 0, imageWidth, imageHeight};
        const int row = held.width() + form.padding;
        const auto pixels = static_cast<std::size_t>(row * held.height());
        bytes.assign(form.isFloat ? 0 : 4 * pixels, 199);
        floats.assign(form.isFloat ? 4 * pixels : 0, std::numeric_limits<float>::quiet_NaN());
        depths.assign(pixels, -1.0f); // in front of everything, if it were read
        for (int y = valid.y0; y < valid.y1; ++y)
            for (int x = valid.x0; x < valid.x1; ++x) {
                const Source s = sourceAt(rank, x, form.bottomUp ? imageHeight - 1 - y : y, form.hasStraightAlpha);
                const auto i = static_cast<std::size_t>((y - held.y0) * row + x - held.x0);
                depths[i] = s.depth;
                for (std::size_t c = 0; c < 4; ++c) {
                    const int level = s.levels[form.isBgra && c < 3 ? 2 - c : c];
                    if (form.isFloat)
                        floats[4 * i + c] = static_cast<float>(level) / 255.0f;
                    else
                        bytes[4 * i + c] = static_cast<std::uint8_t>(level);
                }
            }
        if (form.isFloat)
            image.rgba32f = floats.data();
        else
            image.rgba8 = bytes.data();
        image.depth = hasDepth ? depths.data() : nullptr;
        image.farDepth = 1;
        image.bottomUp = form.bottomUp;
        image.isBgra = form.isBgra;
        image.hasStraightAlpha = form.hasStraightAlpha;
        image.rowPixels = form.padding > 0 ? row : 0;
        image.region = form.isPart ? valid : dfb::Region{0, 0, 0, 0};
        image.valid = valid;
    }

    // Moves the image to memory that other ranks see, as long as the result lives. Bytes begin at an odd address.
    dfb::Buffer moveTo(const dfb::ImageCompositor& compositor)
    {
        dfb::Buffer memory = compositor.sharedMemory(bytes.size() + 4 * floats.size() + 4 * depths.size() + 1);
        std::byte* end = memory.data();
        const auto move = [&](auto& values, auto*& pointer) {
            if (!pointer)
                return;
            std::memcpy(end, values.data(), values.size() * sizeof values[0]);
            pointer = reinterpret_cast<std::decay_t<decltype(pointer)>>(end);
            end += values.size() * sizeof values[0];
            values.assign(values.size(), 77); // nobody may read the old place
        };
        move(floats, image.rgba32f);
        move(depths, image.depth);
        ++end;
        move(bytes, image.rgba8);
        return memory;
    }
};

constexpr std::array<float, 4> background{0.25f, 0.5f, 0.125f, 0.75f};

struct Expected {
    std::array<double, 4> rgba{};
    float depth = std::numeric_limits<float>::infinity();
};

// `placeOf(rank)` is the rank's place in the order.
template <class PlaceOf>
Expected expectedAt(int x, int y, int ranks, dfb::ImageBlend blend, bool hasStraightAlpha, bool hasDepth,
                    const PlaceOf& placeOf)
{
    std::vector<std::tuple<double, int, Source>> layers;
    for (int rank = 0; rank < ranks; ++rank)
        if (isIn(validOf(rank), x, y)) {
            const Source s = sourceAt(rank, x, y, hasStraightAlpha);
            if (hasDepth && s.depth >= 1)
                continue;
            const double key = blend == dfb::ImageBlend::InOrder ? placeOf(rank) : static_cast<double>(s.depth);
            layers.emplace_back(key, rank, s);
        }
    std::sort(layers.begin(), layers.end(), [](const auto& a, const auto& b) {
        return std::make_pair(std::get<0>(a), std::get<1>(a)) < std::make_pair(std::get<0>(b), std::get<1>(b));
    });
    if (blend == dfb::ImageBlend::Nearest && layers.size() > 1)
        layers.resize(1);
    Expected e;
    double through = 1;
    for (const auto& [key, rank, s] : layers) {
        const double alpha = s.levels[3] / 255.0;
        for (std::size_t c = 0; c < 4; ++c)
            e.rgba[c] += through * s.levels[c] / 255.0 * (hasStraightAlpha && c < 3 ? alpha : 1.0);
        through *= 1 - alpha;
        // By depth, a pixel with alpha 0 does not count, as its colours are 0, too. For the nearest, the depth alone
        // decides.
        if (hasDepth && (s.levels[3] > 0 || blend == dfb::ImageBlend::Nearest))
            e.depth = std::min(e.depth, s.depth);
    }
    for (std::size_t c = 0; c < 4; ++c)
        e.rgba[c] += through * static_cast<double>(background[c]);
    return e;
}

struct Images {
    static Result run(const Transport::Communicator& communicator)
    {
        const std::vector<Form> forms{{"8 bit", false, false, false, false},
                                      {"OpenGL", false, true, false, false},
                                      {"BGRA in wide rows", false, false, true, false, 5},
                                      {"straight alpha", false, true, true, true, 3},
                                      {"floats", true, false, false, false},
                                      {"floats with straight alpha", true, true, false, true, 7},
                                      {"only what is valid", false, true, false, false, 2, true}};
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const auto executor = std::make_shared<dfb::ThreadExecutor>(2);
        const int ranks = connection->size();
        const auto placeOf = [&](int rank) { return (rank + 2) % ranks; };
        for (const auto blend : {dfb::ImageBlend::Nearest, dfb::ImageBlend::ByDepth, dfb::ImageBlend::InOrder}) {
            const bool hasDepth = blend != dfb::ImageBlend::InOrder;
            std::array<std::vector<Expected>, 2> expected; // with straight alpha: 1
            for (int y = 0; y < imageHeight && connection->rank() == ranks - 1; ++y)
                for (int x = 0; x < imageWidth; ++x)
                    for (const bool isStraight : {false, true})
                        expected[isStraight].push_back(expectedAt(x, y, ranks, blend, isStraight, hasDepth, placeOf));
            for (const bool toBytes : {true, false}) {
                dfb::FrameBufferConfig config(imageWidth, imageHeight,
                                              toBytes ? dfb::OutputFormat::RGBA8 : dfb::OutputFormat::RGBA32F,
                                              hasDepth && !toBytes);
                config.executor = executor;
                config.image.displayRank = ranks - 1;
                dfb::ImageCompositor compositor(connection, blend, config);
                result.expect(compositor.image().empty(), "an image before the first");
                for (std::size_t f = 0; f < forms.size(); ++f) {
                    const Form& form = forms[f];
                    const bool toBottomUp = (f % 2 == 0) == toBytes;
                    compositor.setBottomUp(toBottomUp);
                    dfb::FrameConfig frame;
                    frame.background = background;
                    const int place = blend == dfb::ImageBlend::InOrder ? placeOf(compositor.rank()) : -1;
                    {
                        const OwnImage own(compositor.rank(), form, hasDepth);
                        compositor.start(own.image, place, frame);
                    } // it is not needed any more
                    compositor.end();
                    const auto checkImage = [&] {
                        if (compositor.isDisplayRank())
                            check(result, compositor.image(), expected[form.hasStraightAlpha], form, blend, toBottomUp);
                    };
                    checkImage();
                    // Memory that stays unchanged: visible to this rank only, or to others as well.
                    OwnImage own(compositor.rank(), form, hasDepth);
                    for (const bool isShared : {false, true}) {
                        const dfb::Buffer memory = isShared ? own.moveTo(compositor) : dfb::Buffer();
                        compositor.composite(own.image, place, frame);
                        checkImage();
                    }
                }
            }
        }
        return result;
    }

    static void check(Result& result, const dfb::Image& image, const std::vector<Expected>& expected, const Form& form,
                      dfb::ImageBlend blend, bool toBottomUp)
    {
        int wrong = 0, wrongDepths = 0;
        const bool isFloat = image.format() == dfb::OutputFormat::RGBA32F;
        for (int y = 0; y < imageHeight; ++y)
            for (int x = 0; x < imageWidth; ++x) {
                const Expected& e = expected[static_cast<std::size_t>(y * imageWidth + x)];
                const auto i = static_cast<std::size_t>((toBottomUp ? imageHeight - 1 - y : y) * imageWidth + x);
                for (std::size_t c = 0; c < 4; ++c) {
                    // Colours are floats on the way: they are rounded by 2^-24 for each of 7 layers, and twice if they
                    // are multiplied by alpha.
                    constexpr double rounding = 14 * 0x1p-24;
                    if (isFloat)
                        wrong += !(std::abs(static_cast<double>(image.rgba32f()[4 * i + c]) - e.rgba[c])
                                   <= rounding + 0x1p-24);
                    else
                        wrong += !(std::abs(image.rgba8()[4 * i + c] - 255 * e.rgba[c]) <= 0.5 + 255 * rounding);
                }
                if (image.hasDepth())
                    wrongDepths += image.depth()[i] != e.depth;
            }
        const std::string name = std::string(form.name) + (toBottomUp ? ", to bottom-up" : "") + ", blend "
                                 + std::to_string(static_cast<int>(blend));
        result.expect(wrong == 0, name + ": " + std::to_string(wrong) + " wrong values");
        result.expect(wrongDepths == 0, name + ": " + std::to_string(wrongDepths) + " wrong depths");
    }
};

// 8-bit images travel as bytes and give the same picture as floats of the same values, bit for bit.
struct BytesAndFloats {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const auto executor = std::make_shared<dfb::ThreadExecutor>(2);
        for (const auto format : {dfb::OutputFormat::RGBA32F, dfb::OutputFormat::RGBA8})
            for (const auto blend : {dfb::ImageBlend::Nearest, dfb::ImageBlend::ByDepth, dfb::ImageBlend::InOrder}) {
                dfb::FrameBufferConfig config(imageWidth, imageHeight, format);
                config.executor = executor;
                config.image.ownerMap = dfb::latticeOwner; // both pictures have the same owners
                dfb::ImageCompositor compositor(connection, blend, config);
                const int place = blend == dfb::ImageBlend::InOrder ? compositor.rank() : -1;
                std::vector<std::vector<std::byte>> pictures;
                std::vector<std::int64_t> bytes;
                for (const bool isFloat : {false, true}) {
                    const OwnImage own(compositor.rank(), {"", isFloat, false, false, false}, true);
                    bytes.push_back(compositor.composite(own.image, place).bytesSent);
                    const dfb::Image& image = compositor.image();
                    const std::size_t size = image.empty() ? 0 : image.pixelCount() * dfb::bytesPerPixel(format);
                    pictures.emplace_back(image.bytes(), image.bytes() + size);
                }
                result.expect(pictures[0] == pictures[1], "floats give another picture");
                result.expect(compositor.size() == 1 || bytes[0] < bytes[1], "8 bits are no fewer bytes");
            }
        return result;
    }
};

// A pixel at infinite depth counts if it has a colour, in every form.
struct AtInfinity {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const std::uint8_t pixel[] = {100, 100, 100, 255};
        const float depth[] = {std::numeric_limits<float>::infinity()};
        for (const auto blend : {dfb::ImageBlend::ByDepth, dfb::ImageBlend::InOrder}) {
            dfb::ImageCompositor compositor(connection, blend, dfb::FrameBufferConfig(1, 1));
            for (const char* form : {"RGBA", "BGRA", "straight"}) {
                dfb::InputImage image(pixel, depth);
                image.isBgra = form[0] == 'B';
                image.hasStraightAlpha = form[0] == 's';
                compositor.composite(image, compositor.rank());
                result.expect(!compositor.isDisplayRank() || compositor.image().rgba8()[0] == 100,
                              std::string("nothing in ") + form);
            }
        }
        return result;
    }
};

// With FrameConfig::order no depth is sent. Pixels at farDepth are empty all the same: those of all ranks but the last.
struct FarInOrder {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        dfb::ImageCompositor compositor(dfb::connect<Transport>(communicator), dfb::ImageBlend::ByDepth,
                                        dfb::FrameBufferConfig(imageWidth, imageHeight));
        const bool isLast = compositor.rank() == compositor.size() - 1;
        const auto pixelCount = static_cast<std::size_t>(imageWidth) * imageHeight;
        const std::uint8_t red = isLast ? 0 : 255, blue = isLast ? 255 : 0;
        std::vector<std::uint8_t> bytes;
        for (std::size_t i = 0; i < pixelCount; ++i)
            bytes.insert(bytes.end(), {red, 0, blue, 255});
        std::vector<float> floats;
        for (const std::uint8_t byte : bytes)
            floats.push_back(byte > 0 ? 1.0f : 0.0f);
        const std::vector<float> depths(pixelCount, isLast ? 0.5f : 1.0f);
        std::vector<std::uint32_t> ranks(static_cast<std::size_t>(compositor.size()));
        std::iota(ranks.begin(), ranks.end(), 0u);
        dfb::FrameConfig frame;
        frame.order = std::make_shared<const dfb::SourceOrder>(ranks);
        for (const bool isFloat : {false, true})
            for (const bool stays : {false, true}) {
                dfb::InputImage image(bytes.data(), depths.data());
                if (isFloat) {
                    image.rgba8 = nullptr;
                    image.rgba32f = floats.data();
                }
                image.farDepth = 1;
                image.staysUntilEnd = stays;
                compositor.composite(image, frame);
                int wrong = 0;
                for (std::size_t i = 0; i < compositor.image().pixelCount(); ++i)
                    wrong += compositor.image().rgba8()[4 * i] != 0;
                result.expect(wrong == 0, std::to_string(wrong) + " pixels of what is empty, in "
                                              + (isFloat ? "floats" : "bytes") + (stays ? " that stay" : ""));
            }
        return result;
    }
};

// A rank that shows nothing needs no place in the order; one that shows something needs one.
struct Places {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        dfb::ImageCompositor compositor(dfb::connect<Transport>(communicator), dfb::ImageBlend::InOrder,
                                        dfb::FrameBufferConfig(1, 1));
        const std::uint8_t pixel[] = {100, 100, 100, 255};
        const bool isLast = compositor.rank() == compositor.size() - 1;
        const std::string fine = scene::outcomeOf([&] {
            if (isLast)
                compositor.composite({});
            else
                compositor.composite(dfb::InputImage(pixel), compositor.rank());
        });
        result.expect(fine == "fine", fine);
        const std::string wrong =
            scene::outcomeOf([&] { compositor.composite(dfb::InputImage(pixel), isLast ? -1 : compositor.rank()); });
        result.expect(wrong.find("place -1 in an order") != std::string::npos, "without a place: " + wrong);

        // Places that are found from a box of each rank.
        const auto at = static_cast<float>(-compositor.rank());
        const dfb::Box3 box{{0, 0, at}, {1, 1, at + 1}};
        const dfb::SharedWorld world(compositor, dfb::World({{static_cast<std::uint32_t>(compositor.rank()), box}}));
        const std::vector<int> order = dfb::visibilityOrder(world, dfb::Vec3{0, 0, 9});
        result.expect(static_cast<int>(order.size()) == compositor.size() && std::is_sorted(order.begin(), order.end()),
                      "the order of the ranks' boxes");
        return result;
    }
};

// Invalid images and other sizes: the error is the same on all ranks, and the next picture is right.
struct Failures {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const dfb::FrameBufferConfig config(imageWidth, imageHeight); // with its default executor
        dfb::ImageCompositor compositor(dfb::connect<Transport>(communicator), dfb::ImageBlend::Nearest, config);
        std::vector<std::uint8_t> pixels(4 * 300 * 200, 255);
        for (std::uint32_t i = 0; i < pixels.size(); ++i)
            if (i % 4 < 3)
                pixels[i] = static_cast<std::uint8_t>(mixed(i, 0, 0) & 255);
        const std::vector<float> depths(300 * 200, 0.5f);
        const dfb::InputImage good(pixels.data(), depths.data());
        const auto isGood = [&](const dfb::Image& image) {
            return std::equal(image.rgba8(), image.rgba8() + 4 * image.pixelCount(), pixels.begin());
        };
        const auto expectGood = [&](int width, int height, const std::string& when) {
            compositor.composite(good);
            const dfb::Image& image = compositor.image();
            result.expect(!compositor.isDisplayRank()
                              || (image.width() == width && image.height() == height && isGood(image)),
                          "a wrong picture after " + when);
        };
        const auto expectError = [&](const dfb::InputImage& image, const char* what, const std::string& part) {
            const std::string text = scene::outcomeOf(
                [&] { compositor.composite(compositor.rank() == compositor.size() - 1 ? image : good); });
            result.expect(text.find("FrameError") != std::string::npos && text.find(part) != std::string::npos,
                          std::string(what) + ": " + text);
            result.expect(compositor.image().empty(), std::string(what) + ": an image after an error");
            expectGood(imageWidth, imageHeight, what);
        };
        expectError(dfb::InputImage(pixels.data()), "no depth", "without depth");
        dfb::InputImage narrow = good;
        narrow.rowPixels = imageWidth - 1;
        expectError(narrow, "narrow rows", "149 pixels apart");
        dfb::InputImage farNowhere = good;
        farNowhere.farDepth = std::numeric_limits<float>::quiet_NaN();
        expectError(farNowhere, "a NaN as farDepth", "farDepth is not a number");
        dfb::InputImage both = good;
        both.rgba32f = depths.data();
        expectError(both, "two images", "of 8 bits and of floats");
        dfb::InputImage inverted = good;
        inverted.region = {10, 10, 5, 20};
        expectError(inverted, "an inverted region", "invalid argument: rank");
        dfb::InputImage depthAlone;
        depthAlone.depth = depths.data();
        expectError(depthAlone, "depth alone", "with depth and without colour");

        // An image without pixels, as of data outside the view: its pointers must not be read.
        dfb::InputImage nothing = good;
        nothing.rgba8 = reinterpret_cast<const std::uint8_t*>(16);
        nothing.depth = reinterpret_cast<const float*>(16);
        nothing.region = {10, 10, 10, 10};
        const auto report = compositor.composite(nothing);
        result.expect(report.tilesTouched == 0, "an image without pixels touches tiles");
        expectGood(imageWidth, imageHeight, "images without pixels");

        const std::string passes = scene::outcomeOf([&] {
            dfb::FrameConfig frame;
            frame.passes = compositor.rank() == 0 ? 2 : 1;
            compositor.composite(good, frame);
        });
        result.expect(passes.find("FrameError") != std::string::npos && passes.find("one sample") != std::string::npos,
                      "two passes on a rank: " + passes);
        expectGood(imageWidth, imageHeight, "two passes on a rank");

        for (const auto& [why, part] :
             {std::make_pair(std::make_exception_ptr(std::runtime_error("no mesh")), "no mesh"),
              std::make_pair(std::exception_ptr(), "no exception")}) {
            const std::string failed = scene::outcomeOf([&, why = why] {
                if (compositor.rank() < compositor.size() - 1)
                    compositor.start(good);
                else
                    compositor.startFailed(why);
                compositor.end();
            });
            result.expect(failed.find("FrameError") != std::string::npos && failed.find(part) != std::string::npos,
                          "startFailed(): " + failed);
            expectGood(imageWidth, imageHeight, "startFailed()");
        }

        // The second is wider and the third is higher than a strip may be.
        for (const auto& [width, height] :
             {std::make_pair(64, 31), std::make_pair(5000, 12), std::make_pair(6, 10000), std::make_pair(300, 200)}) {
            compositor.resize(width, height);
            result.expect(compositor.image().empty(), "an image after resize()");
            expectGood(width, height, "resize()");
        }
        const std::string text = scene::outcomeOf([&] { compositor.resize(0, 10); });
        result.expect(text.find("InvalidArgument") != std::string::npos, "resize() to nothing: " + text);
        expectGood(300, 200, "resize() that failed");

        const bool isLast = compositor.rank() == compositor.size() - 1;
        if (compositor.size() > 1) {
            const std::string calls = scene::outcomeOf([&] {
                if (isLast)
                    compositor.imageOnAllRanks();
                else
                    compositor.resize(64, 31);
            });
            const std::string last = " rank " + std::to_string(compositor.size() - 1);
            result.expect(scene::has(calls, "InvalidArgument") && scene::has(calls, " calls resize(),")
                              && scene::has(calls, last + " imageOnAllRanks(): all ranks must make the same calls"),
                          "different calls: " + calls);
            expectGood(300, 200, "different calls");
            const std::string blends = scene::outcomeOf([&] {
                dfb::ImageCompositor(dfb::connect<Transport>(communicator),
                                     isLast ? dfb::ImageBlend::ByDepth : dfb::ImageBlend::Nearest, config);
            });
            result.expect(scene::has(blends, "ImageBlend::Nearest on rank ")
                              && scene::has(blends, " and ImageBlend::ByDepth on" + last),
                          "different ways to blend: " + blends);
        }

        compositor.start(good);
        for (const std::string& misuse :
             {scene::outcomeOf([&] { compositor.start(good); }), scene::outcomeOf([&] { compositor.resize(8, 8); })})
            result.expect(misuse.find("while a picture is open") != std::string::npos, "misuse: " + misuse);
        compositor.end();
        const std::string twice = scene::outcomeOf([&] { compositor.end(); });
        result.expect(twice.find("end() without start()") != std::string::npos, "end() twice: " + twice);

        if (compositor.size() > 1) { // its destructor leaves the picture, unless that has ended well since start()
            const std::string left = scene::outcomeOf([&] {
                dfb::ImageCompositor other(dfb::connect<Transport>(communicator), dfb::ImageBlend::Nearest, config);
                other.start(good);
                if (isLast)
                    return;
                other.end();
                result.expect(!other.isDisplayRank() || isGood(other.image()), "a wrong picture that a rank has left");
            });
            result.expect(left == "fine" || (!isLast && scene::has(left, "the frame was left without end()")),
                          "a compositor that goes while a picture is open: " + left);
        }
        return result;
    }
};

} // namespace

TEST_CASE("Finished images of any form become the picture that a composition in double gives", "[image_compositor]")
{
    everywhere<Images>();
}

TEST_CASE("Images of 8 bits travel as bytes and give what floats give", "[image_compositor]")
{
    everywhere<BytesAndFloats>();
}

TEST_CASE("A pixel at infinite depth is in the picture whatever form its image has", "[image_compositor]")
{
    everywhere<AtInfinity>();
}

TEST_CASE("A pixel at farDepth is empty in a picture with an order", "[image_compositor]") { everywhere<FarInOrder>(); }

TEST_CASE("Only a rank that shows something needs a place in the order, which its box gives", "[image_compositor]")
{
    everywhere<Places>();
}

TEST_CASE("An image that cannot be fails the picture on all ranks, and resize() changes its size", "[image_compositor]")
{
    everywhere<Failures>();
}

} // namespace frame_cases
