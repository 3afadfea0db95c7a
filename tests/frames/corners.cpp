// Corners: each rank in turn makes a frame fail, in every way and at every point of the frame, with each loop and
// operation. All ranks must get the same error, which says who failed and where, or the image without the tiles that
// the error is about. The next frame on the same framebuffer must be right. In one process and over MPI
// (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstring>
#include <map>
#include <memory>
#include <numeric>
#include <optional>
#include <set>
#include <stdexcept>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

namespace frame_cases {

namespace corners {

// What goes wrong on one rank, the culprit.
enum Kind {
    // An exception of user code: one call, given by its number, throws.
    Render,
    Copy, // of the tile operation's frame data
    NewFrame,
    Add,
    Finish,
    PixelNewFrame,
    Process,
    Sites,
    // Something that the culprit does with its frame.
    Abort = Sites,
    Cancel,
    Leave,           // without end()
    Duplicate,       // an input is sent again
    WrongGeneration, // or in a generation that nobody announced
    OneTooMany,      // or from a source of which nobody said anything
    NoDeclaration,
    OtherBackground, // than the others begin the frame with
    Kinds
};
inline bool isExtraInput(int kind) { return kind == Duplicate || kind == WrongGeneration || kind == OneTooMany; }

// The point at which the culprit fails. AtEnd: after it has sent all of its inputs.
enum Phase { First, Middle, Last, AtEnd, Phases };

// The user code of one rank: counts its calls, and throws in one of them if it is told to.
class Trap {
public:
    // Makes call number `call` (from 0) of this kind throw, or none if it is -1.
    void set(int kind, int call)
    {
        for (auto& count : calls_)
            count = 0;
        fired_ = 0;
        tile_ = -1;
        kind_ = kind;
        call_ = call;
    }
    void pass(int kind, int tile = -1)
    {
        const int call = calls_[static_cast<std::size_t>(kind)]++;
        if (kind != kind_ || call != call_)
            return;
        ++fired_;
        tile_ = tile;
        throw std::runtime_error("sprung");
    }
    int calls(int kind) const { return calls_[static_cast<std::size_t>(kind)]; }
    int fired() const { return fired_; }
    int tile() const { return tile_; } // where it did

private:
    std::array<std::atomic<int>, Sites> calls_{};
    std::atomic<int> kind_{-1}, call_{-1}, fired_{0}, tile_{-1};
};

struct TrapData {
    Trap* trap = nullptr;

    TrapData() = default;
    explicit TrapData(Trap* t) : trap(t) {}
    TrapData(const TrapData& other) : trap(other.trap) { pass(); }
    TrapData& operator=(const TrapData& other)
    {
        other.pass();
        trap = other.trap;
        return *this;
    }

private:
    void pass() const
    {
        if (trap)
            trap->pass(Copy);
    }
};

template <class Base>
class Trapped : public Base {
public:
    using FrameData = TrapData;

    void newFrame(const dfb::TileInfo& info, const TrapData& data)
    {
        trap_ = data.trap;
        tile_ = info.tile;
        isReady_ = false;
        trap_->pass(NewFrame, tile_);
        Base::newFrame(info);
        isReady_ = true;
    }
    void add(dfb::Fragment&& fragment)
    {
        checkReady();
        trap_->pass(Add, tile_);
        Base::add(std::move(fragment));
    }
    void finish(dfb::FinishedTile& out)
    {
        checkReady();
        trap_->pass(Finish, tile_);
        Base::finish(out);
    }

private:
    void checkReady() const
    {
        if (!isReady_)
            throw std::logic_error("an operation is used whose newFrame() has failed");
    }
    Trap* trap_ = nullptr;
    int tile_ = -1;
    bool isReady_ = false;
};

template <bool Pointwise>
struct TrappedPixels {
    static constexpr bool pointwise = Pointwise;
    struct FrameData {
        Trap* trap = nullptr;
    };
    Trap* trap = nullptr;

    void newFrame(const FrameData& data)
    {
        trap = data.trap;
        trap->pass(PixelNewFrame);
    }
    void process(dfb::PixelTile& pixels) const
    {
        const bool isBackground = Pointwise && pixels.pixelCount() == 1; // of no tile
        trap->pass(Process, isBackground ? -1 : pixels.tile);
    }
};

enum class Loop { Data, Mixed, Ordered, ImageOwned, ImageRoundRobin, ImageDynamic, Deep, ByHand };

inline bool isDeclared(Loop loop) { return loop == Loop::Data || loop == Loop::Mixed || loop == Loop::Deep; }
inline bool isImageParallel(Loop loop)
{
    return loop == Loop::ImageOwned || loop == Loop::ImageRoundRobin || loop == Loop::ImageDynamic;
}

// The second sample of a brick at a pixel, if it has one. Only the loop with deep fragments renders it.
inline std::optional<dfb::testing::Sample> secondOf(const dfb::testing::Sample& first, int x, int y)
{
    if ((x + y) % 2 == 0)
        return std::nullopt;
    dfb::testing::Sample second = first;
    second.depth += 0.5f;
    second.part = 1;
    return second;
}

inline std::vector<dfb::testing::Pixel> referenceOf(const scene::Scene& s, Loop loop)
{
    if (loop != Loop::Deep)
        return scene::referenceOf(s);
    std::vector<dfb::testing::Pixel> result;
    for (int y = 0; y < s.height; ++y)
        for (int x = 0; x < s.width; ++x) {
            std::vector<dfb::testing::Sample> samples;
            for (const dfb::Brick& brick : s.bricks)
                if (const auto sample = sampleOf(s, brick, 0, x, y); sample && sample->rgba != std::array<float, 4>{}) {
                    samples.push_back(*sample);
                    if (const auto second = secondOf(*sample, x, y))
                        samples.push_back(*second);
                }
            result.push_back(dfb::testing::composite(std::move(samples), s.background));
        }
    return result;
}

inline scene::Scene sceneFor(Loop loop, dfb::BlendRule rule, std::uint64_t seed)
{
    scene::Scene s = scene::makeScene(isImageParallel(loop) ? 1 : 5, 7, 96, 80);
    s.seed = seed; // the same bricks, with other pixels
    s.rule = rule;
    return s;
}

struct Fault {
    int kind = -1, phase = First;
    bool partial = false;
    int culprit = -1;
    int call = -1; // of user code, that throws
};

inline std::string nameOf(const Fault& fault)
{
    static const char* const kinds[] = {"render",   "copy",           "newFrame",    "add",
                                        "finish",   "pixel newFrame", "process",     "abort",
                                        "cancel",   "leave",          "duplicate",   "wrong generation",
                                        "too many", "no declaration", "disagreement"};
    static const char* const phases[] = {"first", "middle", "last", "at the end"};
    static_assert(sizeof kinds / sizeof *kinds == Kinds && sizeof phases / sizeof *phases == Phases);
    return std::string(kinds[fault.kind]) + ", " + phases[fault.phase] + ", rank " + std::to_string(fault.culprit)
           + (fault.partial ? ", partial" : "");
}

// The outcome of a frame on one rank.
struct Ending {
    std::string text;
    std::optional<dfb::ErrorInfo> error;
    dfb::FrameReport report;
    bool isOver = true; // else it was left
};

// Tests all faults that are possible with one loop and operation, on one framebuffer.
template <class TileOp, class PixelOp>
class Corner {
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, Transport>;
    using Frame = typename FrameBuffer::Frame;
    using Tile = typename FrameBuffer::Tile;

public:
    Corner(const std::shared_ptr<dfb::Connection>& connection, const dfb::FrameBufferConfig& config, Loop loop,
           dfb::BlendRule rule, Result& result)
        : fb_(connection, config), loop_(loop), result_(result), good_(sceneFor(loop, rule, 11)),
          other_(sceneFor(loop, rule, 12)), mine_(bricksOf(good_, fb_.rank(), fb_.size())), world_(fb_, copiesOf(mine_))
    {
    }

    // Returns the number of faults tested. Collective.
    int run()
    {
        std::uint64_t hash = 0;
        dryRun(hash);
        const std::vector<Fault> faults = allFaults();
        std::vector<std::string> texts; // of all that has gone wrong
        for (const Fault& fault : faults) {
            name_ = nameOf(fault);
            const auto start = std::chrono::steady_clock::now();
            const Ending ending = frameOf(other_, fault);
            if (ending.isOver)
                check(fault, ending);
            texts.push_back(fault.kind == Leave ? "left" : ending.text);
            const Ending after = frameOf(good_, {});
            expect(!after.error, "the frame after: " + after.text);
            if (fb_.isDisplayRank() && !after.error)
                expect(scene::Picture(fb_.image(), after.report).hash() == hash, "the frame after is wrong");
            expect(std::chrono::steady_clock::now() - start < std::chrono::milliseconds(timeoutMs / 2),
                   "it was waited for");
        }
        compare(texts, faults);
        result_.hash = result_.hash * 31 + hash;
        return static_cast<int>(faults.size());
    }

private:
    static constexpr int timeoutMs = 20000; // nothing waits for it

    dfb::World copiesOf(const std::vector<dfb::Brick>& mine) const
    {
        dfb::World world(mine);
        if (loop_ == Loop::Mixed) // each brick on the next rank, too
            for (const dfb::Brick& b : bricksOf(good_, (fb_.rank() + fb_.size() - 1) % fb_.size(), fb_.size()))
                if (fb_.size() > 1)
                    world.add(b);
        return world;
    }

    void expect(bool condition, const std::string& what) { result_.expect(condition, prefix() + what); }
    std::string prefix() const { return "loop " + std::to_string(static_cast<int>(loop_)) + ", " + name_ + ": "; }

    // Renders each scene without a fault and compares it with the reference. Records how often each rank calls user
    // code.
    void dryRun(std::uint64_t& hash)
    {
        name_ = "nothing";
        for (const scene::Scene* s : {&other_, &good_}) {
            const Ending ending = frameOf(*s, {});
            expect(!ending.error, ending.text);
            if (!fb_.isDisplayRank() || ending.error)
                continue;
            const scene::Picture picture(fb_.image(), ending.report);
            expect(wrongValues(picture, referenceOf(*s, loop_)) == 0, "values");
            hash = picture.hash();
            if (s == &other_)
                whole_ = picture;
        }
        hash = shared(hash);
        std::array<std::int32_t, Sites + 2> mine{};
        for (int kind = 0; kind < Sites; ++kind)
            mine[static_cast<std::size_t>(kind)] = trap_.calls(kind);
        mine[Sites] = sent_.has_value();
        mine[Sites + 1] = sentToSelf_.has_value();
        std::vector<std::byte> bytes(sizeof mine);
        std::memcpy(bytes.data(), mine.data(), sizeof mine);
        for (const auto& of : fb_.allGather(bytes)) {
            std::memcpy(mine.data(), of.data(), sizeof mine);
            done_.push_back(mine);
        }
    }

    // Returns the display rank's value on all ranks.
    std::uint64_t shared(std::uint64_t value)
    {
        std::vector<std::byte> bytes(sizeof value);
        std::memcpy(bytes.data(), &value, sizeof value);
        std::memcpy(&value, fb_.allGather(bytes)[static_cast<std::size_t>(fb_.config().image.displayRank)].data(),
                    sizeof value);
        return value;
    }

    // The faults to test, the same on all ranks.
    std::vector<Fault> allFaults() const
    {
        std::vector<int> culprits(static_cast<std::size_t>(fb_.size()));
        std::iota(culprits.begin(), culprits.end(), 0);
        if (fb_.size() > 4)
            culprits = {fb_.size() / 2, fb_.size() - 1};
        else if (fb_.size() == 3) // rank 1 is as rank 2 of 4, or 3 of 7
            culprits = {0, 2};
        std::vector<Fault> faults;
        for (const int culprit : culprits)
            for (int kind = 0; kind < Kinds; ++kind)
                for (int phase = 0; phase < Phases; ++phase)
                    for (const bool partial : {false, true}) {
                        Fault fault{kind, phase, partial, culprit, -1};
                        if (isThere(fault))
                            faults.push_back(fault);
                    }
        return faults;
    }

    // Whether the fault is possible and its outcome does not depend on a time-out. Sets fault.call.
    bool isThere(Fault& fault) const
    {
        const auto& done = done_[static_cast<std::size_t>(fault.culprit)];
        const bool byHand = loop_ == Loop::ByHand;
        if (fault.kind < Sites) {
            const int count = done[static_cast<std::size_t>(fault.kind)];
            fault.call = fault.phase == First ? 0 : fault.phase == Middle ? count / 2 : count - 1;
            const bool isNew = fault.phase == First ? count > 0 : fault.phase == Middle ? count > 2 : count > 1;
            if (fault.phase == AtEnd || !isNew)
                return false;
            // Which rank gets a job that is handed out on demand is not known. A partial frame without an input waits
            // for its time-out.
            return fault.kind != Render || (loop_ != Loop::ImageDynamic && !fault.partial);
        }
        if (isExtraInput(fault.kind)) {
            // The owner must see the input before it votes. That is certain only if the culprit itself owns the tile.
            // Otherwise the culprit waits until it hears of the failure, which it never does in a partial frame, as
            // that goes on.
            return loop_ != Loop::ImageDynamic && done[fault.partial ? Sites + 1 : Sites] != 0
                   && (byHand || fault.phase == AtEnd);
        }
        if (fault.kind == NoDeclaration)
            return isDeclared(loop_) && fault.phase == First && !fault.partial;
        if (fault.kind == OtherBackground)
            return fb_.size() > 1 && fault.phase == First;
        return byHand || fault.phase == AtEnd;
    }

    // ---- a frame

    Ending frameOf(const scene::Scene& s, const Fault& fault)
    {
        const bool mine = fault.culprit == fb_.rank();
        trap_.set(mine && fault.kind < Sites ? fault.kind : -1, fault.call);
        dfb::FrameConfig params = paramsOf(s);
        params.timeout = std::chrono::milliseconds(timeoutMs);
        params.allowPartial = fault.partial;
        params.accumulationId = ++accumulation_;
        if (mine && fault.kind == OtherBackground)
            params.background[1] += 0.5f;
        Ending ending;
        try {
            if (mine && fault.kind == NoDeclaration) {
                params.declared = true;
                begin(params).end();
                return ending;
            }
            Frame frame = start(s, params, mine ? fault : Fault());
            if (mine && fault.kind == Leave) {
                ending.isOver = false;
                return ending;
            }
            if (mine && isExtraInput(fault.kind) && !fault.partial) {
                // As long as this rank has not voted, the failure still counts for this frame.
                const auto limit = std::chrono::steady_clock::now() + std::chrono::milliseconds(timeoutMs / 4);
                while (!frame.failed() && std::chrono::steady_clock::now() < limit)
                    if (!fb_.poll()) // where there are no workers, nobody else does
                        std::this_thread::sleep_for(std::chrono::microseconds(100));
            }
            ending.report = frame.end();
            ending.error = ending.report.failure;
            ending.text = ending.error ? "partial: " + ending.error->describe() : "fine";
        } catch (const dfb::FrameError& e) {
            ending.error = e.info();
            ending.text = std::string("FrameError: ") + e.what();
        } catch (const std::exception& e) {
            ending.error.emplace();
            ending.text = std::string("another exception: ") + e.what();
        }
        return ending;
    }

    Frame begin(const dfb::FrameConfig& params)
    {
        if constexpr (std::is_same_v<PixelOp, dfb::NoPixelOp>)
            return fb_.begin(params, TrapData(&trap_));
        else
            return fb_.begin(params, TrapData(&trap_), {&trap_});
    }

    // Renders all inputs of this rank, with `fault` if this rank is the culprit.
    Frame start(const scene::Scene& s, const dfb::FrameConfig& params, const Fault& fault)
    {
        const TrapData data(&trap_);
        typename FrameBuffer::PixelFrameData pixelData{};
        if constexpr (!std::is_same_v<PixelOp, dfb::NoPixelOp>)
            pixelData.trap = &trap_;
        const auto renderOne = [&](const dfb::Brick& b, auto& tile) {
            trap_.pass(Render, tile.tile);
            renderBrick(s, b, tile);
            note(tile);
        };
        const auto renderFirst = [&](auto& tile) { renderOne(s.bricks.front(), tile); };
        const auto started = [&]() -> Frame {
            switch (loop_) {
            case Loop::Mixed: return mixedLoop_.start(scene::FlatCamera(), renderOne, params, data, pixelData);
            case Loop::Ordered: {
                std::vector<int> order(s.bricks.size()); // by id, as in the world
                std::iota(order.begin(), order.end(), 0);
                return orderedLoop_.start(scene::FlatCamera(), order, renderOne, params, data, pixelData);
            }
            case Loop::ImageOwned: return ownedLoop_.start(renderFirst, params, data, pixelData);
            case Loop::ImageRoundRobin: return inTurnLoop_.start(renderFirst, params, data, pixelData);
            case Loop::ImageDynamic: return dynamicLoop_.start(renderFirst, params, data, pixelData);
            case Loop::Deep: return startDeep(s, params, data, pixelData);
            case Loop::ByHand: return byHand(s, params, fault);
            case Loop::Data: break;
            }
            return dataLoop_.start(scene::FlatCamera(), renderOne, params, data, pixelData);
        };
        Frame frame = started();
        if (fault.phase == AtEnd)
            act(frame, fault);
        return frame;
    }

    template <class PixelData>
    Frame startDeep(const scene::Scene& s, const dfb::FrameConfig& params, const TrapData& data,
                    const PixelData& pixelData)
    {
        if constexpr ((TileOp::channels & dfb::farChannel) != 0) {
            const auto render = [&](const dfb::Brick& b, dfb::DeepTile& deep) {
                trap_.pass(Render, deep.header().tile);
                const dfb::Region& r = deep.header().region;
                for (int y = r.y0; y < r.y1; ++y)
                    for (int x = r.x0; x < r.x1; ++x)
                        if (const auto sample = sampleOf(s, b, 0, x, y)) {
                            deep.add(x, y, {sample->rgba, sample->depth, sample->depth});
                            if (const auto second = secondOf(*sample, x, y))
                                deep.add(x, y, {second->rgba, second->depth, second->depth});
                        }
                dfb::TileHeader header = deep.header();
                header.children = std::max(deep.layers() - 1, 0); // as the loop announces them
                note(header);
            };
            return deepLoop_.start(scene::FlatCamera(), render, params, data, pixelData);
        } else {
            return begin(params);
        }
    }

    // A loop as in Listing 3 of the paper.
    Frame byHand(const scene::Scene& s, const dfb::FrameConfig& params, const Fault& fault)
    {
        struct Input {
            int tile;
            const dfb::Brick* brick; // null: the root
            int children;
        };
        std::vector<Input> inputs;
        for (int tile = 0; tile < fb_.layout().tileCount(); ++tile) {
            if (fb_.tileOwner(tile) == fb_.rank())
                inputs.push_back({tile, nullptr, scene::bricksIn(fb_, s, tile)});
            for (const dfb::Brick& b : mine_)
                if (scene::meets(fb_, b, tile))
                    inputs.push_back({tile, &b, 0});
        }
        Frame frame = begin(params);
        const auto tile = std::make_unique<Tile>();
        const std::size_t when[] = {0, inputs.size() / 2, inputs.empty() ? 0 : inputs.size() - 1};
        for (std::size_t i = 0; i < inputs.size() || i == 0; ++i) {
            if (fault.kind >= 0 && fault.phase != AtEnd && when[fault.phase] == i)
                act(frame, fault);
            if (inputs.empty())
                break;
            frame.start(*tile, inputs[i].tile);
            tile->children = inputs[i].children;
            try {
                trap_.pass(Render, tile->tile);
            } catch (...) {
                frame.abort(std::current_exception(), tile->tile);
                continue;
            }
            if (inputs[i].brick) {
                tile->generation = 1;
                tile->source = inputs[i].brick->id;
                renderBrick(s, *inputs[i].brick, *tile);
                note(*tile);
            }
            frame.setTile(*tile);
        }
        return frame;
    }

    // Notes the first input that this rank sends, and the first that it sends to itself. Both are the same in every
    // frame but for the frame number.
    void note(const dfb::TileHeader& header)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        const auto isFirst = [&](const std::optional<dfb::TileHeader>& sent) {
            return !sent || std::make_pair(header.tile, header.source) <= std::make_pair(sent->tile, sent->source);
        };
        if (isFirst(sent_))
            sent_ = header;
        if (fb_.tileOwner(header.tile) == fb_.rank() && isFirst(sentToSelf_))
            sentToSelf_ = header;
    }

    void act(Frame& frame, const Fault& fault)
    {
        if (fault.kind == Abort)
            frame.abort(std::make_exception_ptr(std::runtime_error("sprung")));
        if (fault.kind == Cancel)
            frame.cancel();
        if (!isExtraInput(fault.kind))
            return;
        const dfb::TileHeader header = target(fault);
        const auto tile = std::make_unique<Tile>();
        frame.start(*tile, header.tile);
        tile->generation = header.generation + (fault.kind == WrongGeneration ? 9 : 0);
        tile->source = fault.kind == OneTooMany ? 999 : header.source;
        tile->part = header.part;
        tile->children = fault.kind == Duplicate ? header.children : 0;
        frame.setTile(*tile);
    }

    dfb::TileHeader target(const Fault& fault)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return fault.partial ? *sentToSelf_ : *sent_;
    }

    // ---- the outcome of a frame

    void check(const Fault& fault, const Ending& ending)
    {
        using dfb::ErrorKind;
        if (!ending.error) {
            expect(false, "no failure");
            return;
        }
        const dfb::ErrorInfo& error = *ending.error;
        // A surplus input takes the place of an announced one. That one may come too late to be told from a surplus
        // input.
        const bool isStray = fault.kind == OneTooMany && loop_ == Loop::ByHand && fault.partial
                             && error.kind == ErrorKind::Disagreement && error.got == 1;
        if (isStray) {
            expect(scene::has(ending.text, "FrameError: "), ending.text);
            return;
        }
        const bool isPartial = fault.partial && fault.kind != OtherBackground;
        expect(scene::has(ending.text, isPartial ? "partial: " : "FrameError: "), ending.text);
        std::set<ErrorKind> kinds{ErrorKind::UserCode};
        switch (fault.kind) {
        case Cancel:
        case Leave: kinds = {ErrorKind::Cancelled}; break;
        case OtherBackground: kinds = {ErrorKind::Disagreement}; break;
        case NoDeclaration: kinds = {ErrorKind::InvalidArgument}; break;
        case Duplicate: kinds = {ErrorKind::DuplicateInput}; break;
        case WrongGeneration: kinds = {ErrorKind::UnannouncedInput}; break;
        case OneTooMany: kinds = {ErrorKind::TooManyInputs, ErrorKind::UnannouncedInput}; break;
        default: break;
        }
        if (isExtraInput(fault.kind) && isImageParallel(loop_))
            kinds.insert(ErrorKind::InvalidArgument); // the operation itself refuses it
        expect(kinds.count(error.kind) > 0, ending.text);
        const bool mine = fault.culprit == fb_.rank();
        if (isExtraInput(fault.kind)) {
            expect(error.tile >= 0 && error.tile < fb_.layout().tileCount()
                       && error.rank == fb_.tileOwner(static_cast<int>(error.tile)),
                   "rank: " + ending.text);
            expect(!mine || error.tile == target(fault).tile, "tile: " + ending.text);
        } else if (fault.kind != OtherBackground) {
            expect(error.rank == fault.culprit, "rank: " + ending.text);
        }
        if (fault.kind < Sites) {
            expect(scene::has(ending.text, "sprung"), ending.text);
            expect(trap_.fired() == (mine ? 1 : 0), "fired " + std::to_string(trap_.fired()) + " times");
            expect(!mine || error.tile == trap_.tile(), "tile " + std::to_string(trap_.tile()) + ": " + ending.text);
        }
        if (isPartial && fb_.isDisplayRank())
            checkTiles(fault, ending);
    }

    // On the display rank: complete tiles are right, and the others show the background.
    void checkTiles(const Fault& fault, const Ending& ending)
    {
        const scene::Picture picture(fb_.image(), ending.report);
        std::set<int> incomplete;
        std::size_t wrong = 0;
        for (int tile = 0; tile < fb_.layout().tileCount(); ++tile) {
            const bool isThere = fb_.isComplete(tile);
            if (!isThere)
                incomplete.insert(tile);
            const dfb::Region r = fb_.layout().region(tile);
            for (int y = r.y0; y < r.y1; ++y)
                for (int x = r.x0; x < r.x1; ++x) {
                    const auto at = static_cast<std::size_t>(y * picture.width + x);
                    for (std::size_t c = 0; c < 4; ++c)
                        wrong +=
                            picture.value(4 * at + c) != (isThere ? whole_.value(4 * at + c) : other_.background[c]);
                }
        }
        expect(wrong == 0, std::to_string(wrong) + " values of what is there");
        expect(ending.report.tilesIncomplete == static_cast<std::int64_t>(incomplete.size()), "the count of tiles");
        std::set<int> about{static_cast<int>(ending.error->tile)};
        if (fault.kind == Process && ending.error->tile < 0) { // it was about the background
            about.clear();
            for (int tile = 0; tile < fb_.layout().tileCount(); ++tile)
                if (scene::bricksIn(fb_, good_, tile) == 0)
                    about.insert(tile);
        }
        if (fault.kind == NewFrame || fault.kind == Add || fault.kind == Finish || fault.kind == Process
            || isExtraInput(fault.kind))
            expect(incomplete == about, "other tiles are missing: " + std::to_string(incomplete.size()));
        if (fault.kind == Abort)
            expect(incomplete.empty(), "tiles are missing: " + std::to_string(incomplete.size()));
    }

    // Checks that all ranks have the same text for each fault.
    void compare(const std::vector<std::string>& texts, const std::vector<Fault>& faults)
    {
        std::string mine;
        for (const std::string& text : texts)
            mine += text + '\n';
        std::vector<std::byte> bytes(mine.size());
        std::memcpy(bytes.data(), mine.data(), mine.size());
        const auto all = fb_.allGather(bytes);
        for (std::size_t rank = 0; rank < all.size(); ++rank) {
            const std::string theirs(reinterpret_cast<const char*>(all[rank].data()), all[rank].size());
            std::size_t at = 0;
            for (std::size_t i = 0; i < texts.size() && theirs != mine; ++i) {
                name_ = nameOf(faults[i]);
                const std::string line = theirs.substr(at, theirs.find('\n', at) - at);
                expect(line == texts[i],
                       "[" + line + "] on rank " + std::to_string(rank) + ", [" + texts[i] + "] here");
                at = std::min(theirs.size(), at + line.size() + 1);
            }
        }
    }

    FrameBuffer fb_;
    Loop loop_;
    Result& result_;
    scene::Scene good_, other_; // frames that are to be right, and those that are not
    std::vector<dfb::Brick> mine_;
    dfb::World own_{mine_};
    dfb::SharedWorld world_;
    dfb::RoundRobinBricks inTurn_;
    dfb::ImageParallelLoop<FrameBuffer> ownedLoop_{fb_}, inTurnLoop_{fb_, dfb::WorkDistribution::RoundRobin},
        dynamicLoop_{fb_, dfb::WorkDistribution::Dynamic};
    dfb::DataParallelLoop<FrameBuffer> dataLoop_{fb_, own_};
    dfb::DeepParallelLoop<FrameBuffer> deepLoop_{fb_, own_, 4};
    dfb::MixedParallelLoop<FrameBuffer, dfb::RoundRobinBricks> mixedLoop_{fb_, world_, inTurn_};
    dfb::OrderedLoop<FrameBuffer, dfb::RoundRobinBricks> orderedLoop_{fb_, world_, inTurn_};
    Trap trap_;
    std::uint64_t accumulation_ = 0;
    std::string name_;
    scene::Picture whole_; // of other_
    std::mutex mutex_;
    std::optional<dfb::TileHeader> sent_, sentToSelf_;      // under mutex_
    std::vector<std::array<std::int32_t, Sites + 2>> done_; // in a good frame, by rank
};

} // namespace corners

struct Corners {
    static Result run(const Transport::Communicator& communicator)
    {
        using namespace corners;
        using Blend = Trapped<dfb::BasicAlphaBlend<32>>;
        using Ordered = Trapped<dfb::BasicOrderedBlend<32>>;
        using Depth = Trapped<dfb::BasicDepthComposite<32>>;
        using Whole = Trapped<dfb::BasicImageParallel<32>>;
        using Accumulated = Trapped<dfb::Progressive<dfb::BasicAlphaBlend<32>>>;
        using Deep = Trapped<dfb::BasicDeepBlend<32>>;
        using dfb::BlendRule;
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        Count count{connection->size()};
        faults<Blend, dfb::NoPixelOp>(connection, {Loop::Data, Loop::ByHand, Loop::Mixed}, BlendRule::SortByDepth,
                                      result, count);
        faults<Ordered, dfb::NoPixelOp>(connection, {Loop::Ordered}, BlendRule::InOrder, result, count);
        faults<Depth, TrappedPixels<true>>(connection, {Loop::Data, Loop::ByHand}, BlendRule::Nearest, result, count);
        faults<Whole, TrappedPixels<false>>(connection, {Loop::ImageOwned, Loop::ImageRoundRobin, Loop::ImageDynamic},
                                            BlendRule::SortByDepth, result, count);
        faults<Accumulated, dfb::NoPixelOp>(connection, {Loop::Data}, BlendRule::SortByDepth, result, count);
        faults<Deep, TrappedPixels<false>>(connection, {Loop::Deep}, BlendRule::SortByDepth, result, count);
        static const std::map<int, int> expected{{1, 501}, {2, 1046}, {3, 992}, {4, 1757}, {7, 670}};
        const auto found = expected.find(count.ranks);
        result.expect(found != expected.end() && found->second == count.faults,
                      std::to_string(count.faults) + " faults on " + std::to_string(count.ranks) + " ranks");
        return result;
    }

private:
    struct Count {
        int ranks, loops = 0, faults = 0;
    };

    template <class TileOp, class PixelOp>
    static void faults(const std::shared_ptr<dfb::Connection>& connection, const std::vector<corners::Loop>& loops,
                       dfb::BlendRule rule, Result& result, Count& count)
    {
        for (const corners::Loop loop : loops) {
            dfb::FrameBufferConfig config = configOf(corners::sceneFor(loop, rule, 0), count.loops % 3);
            config.image.displayRank = (count.loops + count.ranks) % 2 == 0 ? 0 : count.ranks - 1;
            config.image.ownerMap = dfb::latticeOwner; // some ranks begin frames without a loop
            corners::Corner<TileOp, PixelOp> corner(connection, config, loop, rule, result);
            count.faults += corner.run();
            ++count.loops;
        }
    }
};

} // namespace frame_cases

TEST_CASE("Whatever fails, where and when: one error on all ranks, or what is left of the image, and the next is right",
          "[corners]")
{
    everywhere<frame_cases::Corners>();
}
