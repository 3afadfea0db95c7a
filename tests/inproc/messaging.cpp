// Credit, several framebuffers on one messenger, messages that come twice or damaged, gathering, and progress by the
// caller: what the messaging layer promises to frames. Ranks are threads; every test has a time limit.
#include "catch.hpp"
#include "scene.hpp"

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <future>
#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace {

using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Picture;
using scene::Scene;

// What happens to the messages of all ranks; and the end of it all when time is up.
struct Board {
    enum class What { Pass, Hold, Lose, Twice, CopyHeld };
    // Called for each message to another rank, from any thread.
    std::function<What(int from, int to, const MessageHeader&, dfb::Buffer&)> inspect;
    // Called when it has been passed on.
    std::function<void(int from, int to, const MessageHeader&)> passed;

    std::mutex mutex;
    std::vector<std::function<void()>> held;
    bool released = false;
    std::vector<dfb::TransportHandler*> handlers;
    std::atomic<bool> timeIsUp{false};
    std::shared_ptr<dfb::MemoryPool> pool = dfb::MemoryPool::create();

    // Until release().
    void hold(std::function<void()> send)
    {
        std::unique_lock<std::mutex> lock(mutex);
        if (!released) {
            held.push_back(std::move(send));
            return;
        }
        lock.unlock();
        send();
    }
    void release()
    {
        std::vector<std::function<void()>> all;
        {
            const std::lock_guard<std::mutex> lock(mutex);
            released = true;
            all.swap(held);
        }
        for (const auto& send : all)
            send();
    }
    // Every rank that waits gets a TransportError.
    void giveUp()
    {
        timeIsUp = true;
        const std::lock_guard<std::mutex> lock(mutex);
        for (dfb::TransportHandler* handler : handlers) {
            dfb::ErrorInfo info;
            info.kind = dfb::ErrorKind::Transport;
            info.message = "the test's time limit";
            handler->fail(info);
        }
    }
};

class BoardTransport {
public:
    struct Communicator {
        dfb::InprocCommunicator inner;
        std::shared_ptr<Board> board;
    };
    [[maybe_unused]] static constexpr const char* name = "board";

    BoardTransport(const Communicator& c, std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress)
        : board_(c.board), inner_(c.inner, std::move(pool), progress)
    {
    }
    int rank() const { return inner_.rank(); }
    int size() const { return inner_.size(); }
    bool needsPolling() const { return inner_.needsPolling(); }
    bool mayPoll() const { return inner_.mayPoll(); }
    bool wakesOnArrival() const { return inner_.wakesOnArrival(); }
    bool quiet() const { return inner_.quiet(); }
    bool poll() { return inner_.poll(); }
    void nap(std::chrono::nanoseconds limit) { inner_.nap(limit); }
    void interrupt() { inner_.interrupt(); }
    void start(dfb::TransportHandler& handler)
    {
        handler_ = &handler;
        {
            const std::lock_guard<std::mutex> lock(board_->mutex);
            board_->handlers.push_back(&handler);
        }
        inner_.start(handler);
    }
    void stop(bool orderly)
    {
        {
            const std::lock_guard<std::mutex> lock(board_->mutex);
            auto& all = board_->handlers;
            all.erase(std::remove(all.begin(), all.end(), handler_), all.end());
        }
        inner_.stop(orderly);
    }
    void send(int to, dfb::Buffer&& message)
    {
        const auto header = dfb::detail::loadAs<MessageHeader>(message.data());
        const auto what = board_->inspect ? board_->inspect(rank(), to, header, message) : Board::What::Pass;
        if (what == Board::What::Lose) {
            const dfb::Buffer lost = std::move(message);
        } else if (what == Board::What::Hold) {
            const auto kept = std::make_shared<dfb::Buffer>(std::move(message));
            board_->hold([this, to, kept] { inner_.send(to, std::move(*kept)); });
        } else {
            const auto copy = std::make_shared<dfb::Buffer>();
            if (what != Board::What::Pass) {
                *copy = board_->pool->acquire(message.size());
                std::memcpy(copy->data(), message.data(), message.size());
            }
            inner_.send(to, std::move(message));
            if (what == Board::What::Twice)
                inner_.send(to, std::move(*copy));
            else if (what == Board::What::CopyHeld)
                board_->hold([this, to, copy] { inner_.send(to, std::move(*copy)); });
            if (board_->passed)
                board_->passed(rank(), to, header);
        }
    }

private:
    std::shared_ptr<Board> board_;
    dfb::InprocTransport inner_;
    dfb::TransportHandler* handler_ = nullptr;
};

// runRanks() over a board, for at most so long.
void runOn(const std::shared_ptr<Board>& board, int ranks,
           const std::function<void(const BoardTransport::Communicator&)>& body,
           std::optional<std::uint64_t> shuffleSeed = std::nullopt,
           std::chrono::seconds limit = std::chrono::seconds(30))
{
    std::promise<void> done;
    std::thread watch([&, over = done.get_future()] {
        if (over.wait_for(limit) == std::future_status::ready)
            return;
        board->giveUp();
        if (over.wait_for(std::chrono::seconds(20)) == std::future_status::ready)
            return;
        std::fputs("a test hangs even after its transport has failed\n", stderr);
        std::abort();
    });
    std::string thrown;
    try {
        dfb::runRanks(
            ranks,
            [&](dfb::InprocCommunicator communicator) {
                body({communicator, board});
            },
            shuffleSeed);
    } catch (const std::exception& e) {
        thrown = e.what();
    }
    done.set_value();
    watch.join();
    CHECK(thrown == "");
    CHECK_FALSE(board->timeIsUp);
}

// Colours are added up as inputs come, and none is kept: small whole numbers, so that any order gives the same.
class Adder {
public:
    static constexpr int tileSize = 32;
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;

    void newFrame(const dfb::TileInfo& info)
    {
        region_ = info.region;
        sum_.assign(static_cast<std::size_t>(4 * region_.width() * region_.height()), 0.0);
    }
    void add(dfb::Fragment&& fragment)
    {
        dfb::FragmentCursor cursor(fragment);
        for (int y = 0; y < region_.height(); ++y) {
            const dfb::FragmentRow row = cursor.next();
            const float* color = row.color;
            for (int s = 0; s < row.spanCount; ++s) {
                double* to = sum_.data() + 4 * (y * region_.width() + row.spans[s].x);
                for (int i = 0; i < 4 * row.spans[s].count; ++i)
                    to[i] += static_cast<double>(*color++);
            }
        }
    }
    void finish(dfb::FinishedTile& out)
    {
        for (int y = 0; y < region_.height(); ++y)
            out.setRow(y, sum_.data() + 4 * y * region_.width(), nullptr);
    }

private:
    dfb::Region region_;
    std::vector<double> sum_;
};
static_assert(dfb::is_tile_op_v<Adder>);

using AddingFrameBuffer = dfb::DistributedFrameBuffer<Adder, dfb::NoPixelOp, BoardTransport>;
template <class TileOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, BoardTransport>;
using Blend = dfb::BasicAlphaBlend<16>;
using Single = dfb::BasicImageParallel<16>;

// What input `part` of rank `rank` has at a pixel.
int valueOf(int rank, int part, int x, int y, int channel)
{
    return 1 + (rank * 7 + part * 11 + x * 3 + y * 5 + channel) % 64;
}

template <class Tile>
void fillTile(Tile& tile, int rank, int part)
{
    for (int y = 0; y < tile.region.height(); ++y)
        for (int x = 0; x < tile.region.width(); ++x)
            for (int c = 0; c < 4; ++c)
                tile.pixel(x, y)[c] =
                    static_cast<float>(valueOf(rank, part, tile.region.x0 + x, tile.region.y0 + y, c));
}

// Number of values that are not the sum of all inputs.
std::size_t wrongSums(const dfb::Image& image, int ranks, int parts)
{
    const Picture p(image, {});
    std::size_t wrong = image.empty();
    for (int y = 0; y < image.height(); ++y)
        for (int x = 0; x < image.width(); ++x)
            for (int c = 0; c < 4; ++c) {
                int sum = 0;
                for (int rank = 0; rank < ranks; ++rank)
                    for (int part = 0; part < parts; ++part)
                        sum += valueOf(rank, part, x, y, c);
                wrong += p.value(4
                                     * (static_cast<std::size_t>(y) * static_cast<std::size_t>(image.width())
                                        + static_cast<std::size_t>(x))
                                 + static_cast<std::size_t>(c))
                         != static_cast<float>(sum);
            }
    return wrong;
}

// Rows of image tiles; the smallest pool that can be.
dfb::FrameBufferConfig floodConfig(int pixels, std::shared_ptr<dfb::Executor> executor)
{
    dfb::FrameBufferConfig config;
    config.width = config.height = pixels;
    config.format = dfb::OutputFormat::RGBA32F;
    config.messagePoolBytes = 0;
    config.executor = std::move(executor);
    return config;
}

std::size_t blockBytes(std::size_t bytes) // as MemoryPool rounds up
{
    std::size_t block = 256;
    while (block < bytes)
        block = block + block / 2 >= bytes ? block + block / 2 : 2 * block;
    return block;
}

// Bytes of the message of a full tile of Adder.
constexpr std::size_t fullMessage = dfb::detail::fragmentPrefix + 16 * Adder::tileSize * Adder::tileSize;

enum class From { Loop, Thread };

// One frame in which every rank sends `parts` inputs for every tile. `sent(tile, body)` is called in place of `body`.
template <class Fb, class Around>
dfb::FrameReport floodFrame(Fb& fb, int parts, From from, const Around& around, int timeoutMs = 0)
{
    dfb::FrameParams params;
    params.declared = true;
    params.timeoutMs = timeoutMs;
    auto frame = fb.begin(params);
    std::vector<dfb::TileInput> inputs;
    for (int part = 0; part < parts; ++part)
        for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
            inputs.push_back({tile, static_cast<std::uint32_t>(fb.rank()), static_cast<std::uint16_t>(part)});
    frame.declare(inputs);
    const auto sendOne = [&](std::size_t i) {
        const auto tile = std::make_unique<typename Fb::Tile>();
        frame.start(*tile, inputs[i].tile);
        tile->generation = 1;
        tile->part = inputs[i].part;
        fillTile(*tile, fb.rank(), inputs[i].part);
        around(inputs[i].tile, [&] { frame.setTile(*tile); });
    };
    if (from == From::Loop)
        fb.executor().parallelFor(inputs.size(), sendOne);
    else
        for (std::size_t i = 0; i < inputs.size(); ++i)
            sendOne(i);
    return frame.end();
}
template <class Fb>
dfb::FrameReport floodFrame(Fb& fb, int parts, From from)
{
    return floodFrame(fb, parts, from, [](int, const auto& send) { send(); });
}

std::vector<std::pair<std::string, std::function<std::shared_ptr<dfb::Executor>()>>> executors()
{
    std::vector<std::pair<std::string, std::function<std::shared_ptr<dfb::Executor>()>>> all;
    for (const int workers : {1, 2}) {
        const std::string count = std::to_string(workers) + " workers, ";
        all.emplace_back(count + "threads", [workers] { return std::make_shared<dfb::ThreadExecutor>(workers); });
#if defined(DFB_HAS_TBB)
        all.emplace_back(count + "oneTBB", [workers] { return std::make_shared<dfb::TbbExecutor>(workers); });
#endif
    }
    return all;
}

std::string joined(const std::vector<std::string>& texts)
{
    std::string all;
    for (const std::string& t : texts)
        all += "\n  " + t;
    return all;
}

dfb::FrameBufferConfig configOf(const Scene& s, int threads = 1)
{
    dfb::FrameBufferConfig config;
    config.width = s.width;
    config.height = s.height;
    config.format = dfb::OutputFormat::RGBA32F;
    config.depth = true;
    config.executor = std::make_shared<dfb::ThreadExecutor>(threads);
    return config;
}

Scene sceneFor(Loop loop, std::uint64_t seed = 1)
{
    Scene s = scene::makeScene(scene::isDataParallel(loop) ? 6 : 1, seed);
    if (!scene::isDataParallel(loop))
        s.bricks[0].bounds = {{0, 0, 0}, {97, 61, 1}};
    return s;
}

} // namespace

// ---- credit

TEST_CASE("All ranks flood one owner that has the smallest pool", "[messaging][flood]")
{
    for (const int ranks : {2, 4, 8})
        for (const auto& [name, makeExecutor] : executors())
            for (const From from : {From::Loop, From::Thread}) {
                INFO(ranks << " ranks, " << name << (from == From::Loop ? ", from a loop" : ", from a thread"));
                const int parts = 16 / ranks;
                std::size_t wrong = 1;
                std::vector<dfb::FrameReport> reports;
                std::size_t pool = 0;
                int threads = 0;
                runOn(std::make_shared<Board>(), ranks, [&, &make = makeExecutor](const auto& communicator) {
                    auto config = floodConfig(256, make());
                    config.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                    AddingFrameBuffer fb(communicator, config);
                    for (int i = 0; i < 2; ++i) {
                        const auto report = floodFrame(fb, parts, from);
                        if (fb.rank() == 0) {
                            wrong = wrongSums(fb.image(), ranks, parts);
                            reports.push_back(report);
                            pool = fb.config().messagePoolBytes;
                            threads = fb.executor().concurrency() + 1;
                        }
                    }
                });
                CHECK(wrong == 0);
                CHECK(pool == std::size_t{1} << 20); // 4 batches of finished tiles
                std::size_t otherMessages = 0;
                for (const dfb::FrameReport& r : reports) {
                    const std::int64_t inputs = 64 * parts * (ranks - 1);
                    CHECK(r.peakInboxBytes > 0);
                    CHECK(r.peakInboxBytes <= static_cast<std::int64_t>(pool));
                    CHECK(r.messagesSent > inputs);
                    CHECK(r.messagesSent < 4 * inputs); // requests and credits
                    otherMessages += static_cast<std::size_t>(r.messagesSent - inputs);
                }
                // A rank's memory: a pool of inputs under way and one more for each thread that sets tiles, those that
                // threads of the owner are just adding up, the small messages, the image. (In one process a message
                // stays in the memory of its sender.)
                const std::size_t blocks = pool / fullMessage + 2 * static_cast<std::size_t>(threads);
                const std::size_t limit = blocks * blockBytes(fullMessage) + otherMessages * 256
                                          + blockBytes(256 * 256 * 16) + 64 * blockBytes(4096);
                REQUIRE(!reports.empty());
                INFO(reports.back().peakMemoryBytes << " bytes, limit " << limit);
                CHECK(reports.back().peakMemoryBytes <= static_cast<std::int64_t>(limit));
            }
}

TEST_CASE("Everybody floods everybody, with arrivals in order and shuffled", "[messaging][flood]")
{
    for (const int ranks : {2, 3, 8})
        for (const auto& [name, makeExecutor] : executors())
            for (const bool shuffle : {false, true}) {
                INFO(ranks << " ranks, " << name << (shuffle ? ", shuffled" : ""));
                std::size_t wrong = 1;
                dfb::FrameReport report;
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&, &make = makeExecutor](const auto& communicator) {
                        AddingFrameBuffer fb(communicator, floodConfig(256, make()));
                        const auto r = floodFrame(fb, 3, From::Loop);
                        if (fb.isDisplayRank()) {
                            wrong = wrongSums(fb.image(), ranks, 3);
                            report = r;
                        }
                    },
                    shuffle ? std::optional<std::uint64_t>(ranks) : std::nullopt);
                CHECK(wrong == 0);
                CHECK(report.peakInboxBytes <= 1 << 20);
            }
}

TEST_CASE("A sender waits when a pool is under way; all workers of all ranks may wait at once", "[messaging][flood]")
{
    // No input arrives until every worker of every rank waits in setTile().
    for (const int ranks : {2, 4})
        for (const int workers : {1, 2}) {
            const std::int64_t fit = (1 << 20) / static_cast<std::int64_t>(fullMessage); // calls that need not wait
            const auto board = std::make_shared<Board>();
            std::atomic<bool> open{false};
            board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
                return header.kind == MessageKind::Fragment && !open ? Board::What::Hold : Board::What::Pass;
            };
            std::mutex mutex;
            std::condition_variable changed;
            std::vector<std::int64_t> begun(static_cast<std::size_t>(ranks)), done(begun), begunThen, doneThen;
            std::thread referee([&] {
                std::unique_lock<std::mutex> lock(mutex);
                changed.wait_for(lock, std::chrono::seconds(20), [&] {
                    bool all = true;
                    for (std::size_t rank = 0; rank < begun.size(); ++rank)
                        all = all && begun[rank] > fit && begun[rank] == done[rank] + workers;
                    return all;
                });
                begunThen = begun;
                doneThen = done;
                lock.unlock();
                open = true;
                board->release();
            });
            std::size_t wrong = 1;
            runOn(board, ranks, [&](const auto& communicator) {
                AddingFrameBuffer fb(communicator, floodConfig(256, std::make_shared<dfb::ThreadExecutor>(workers)));
                const auto rank = static_cast<std::size_t>(fb.rank());
                floodFrame(fb, 4, From::Loop, [&](int tile, const auto& send) {
                    if (fb.tileOwner(tile) == fb.rank()) {
                        send();
                        return;
                    }
                    const auto count = [&](auto& counts) {
                        const std::lock_guard<std::mutex> lock(mutex);
                        ++counts[rank];
                        changed.notify_all();
                    };
                    count(begun);
                    send();
                    count(done);
                });
                if (fb.isDisplayRank())
                    wrong = wrongSums(fb.image(), ranks, 4);
            });
            referee.join();
            INFO(ranks << " ranks, " << workers << " workers");
            for (std::size_t rank = 0; rank < begunThen.size(); ++rank) {
                CHECK(begunThen[rank] > fit);
                CHECK(begunThen[rank] == doneThen[rank] + workers);
                CHECK(doneThen[rank] <= fit);
            }
            CHECK(wrong == 0);
        }
}

TEST_CASE("An owner that takes nothing out of its inbox is sent no more than its pool", "[messaging][flood]")
{
    for (const int ranks : {2, 5}) {
        const auto board = std::make_shared<Board>();
        std::mutex mutex;
        std::condition_variable changed;
        std::size_t inputBytes = 0, bytesThen = 0;
        std::vector<bool> blocked(static_cast<std::size_t>(ranks));
        bool watching = true;
        board->inspect = [&](int, int to, const MessageHeader& header, dfb::Buffer& message) {
            const std::lock_guard<std::mutex> lock(mutex);
            if (to == 0 && header.kind == MessageKind::Fragment && watching)
                inputBytes += message.size();
            return Board::What::Pass;
        };
        std::size_t wrong = 1;
        runOn(board, ranks, [&](const auto& communicator) {
            auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(1));
            config.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
            AddingFrameBuffer fb(communicator, config);
            // The only worker of rank 0, and the thread that calls its framebuffer, are busy with something else until
            // every other rank has set more than a pool's worth.
            const auto allBlocked = [&] {
                std::unique_lock<std::mutex> lock(mutex);
                changed.wait_for(lock, std::chrono::seconds(20),
                                 [&] { return std::count(blocked.begin(), blocked.end(), true) == ranks - 1; });
                if (watching)
                    bytesThen = inputBytes;
                watching = false;
            };
            if (fb.rank() == 0)
                fb.executor().submit(allBlocked);
            std::int64_t begun = 0;
            if (fb.rank() > 0) {
                floodFrame(fb, 2, From::Thread, [&](int, const auto& send) {
                    if (++begun > (1 << 20) / static_cast<std::int64_t>(fullMessage)) {
                        const std::lock_guard<std::mutex> lock(mutex);
                        blocked[static_cast<std::size_t>(fb.rank())] = true;
                        changed.notify_all();
                    }
                    send();
                });
            } else {
                dfb::FrameParams params;
                params.declared = true;
                auto frame = fb.begin(params);
                frame.declare({});
                allBlocked();
                frame.end();
                const Picture p(fb.image(), {});
                int expected = 0;
                for (int rank = 1; rank < ranks; ++rank)
                    expected += valueOf(rank, 0, 9, 0, 0) + valueOf(rank, 1, 9, 0, 0);
                wrong = p.value(4 * 9) != static_cast<float>(expected);
            }
        });
        INFO(ranks << " ranks, " << bytesThen << " bytes");
        CHECK(bytesThen > 0);
        CHECK(bytesThen <= std::size_t{1} << 20);
        CHECK(wrong == 0);
    }
}

TEST_CASE("The display rank is flooded by finished tiles, as they come or at the end", "[messaging][flood]")
{
    for (const auto& [name, makeExecutor] : executors())
        for (const auto gather : {dfb::GatherMode::Batches, dfb::GatherMode::AtEnd}) {
            INFO(name << (gather == dfb::GatherMode::AtEnd ? ", at the end" : ", in batches"));
            std::vector<std::size_t> wrong;
            dfb::FrameReport report;
            std::size_t pool = 0;
            runOn(std::make_shared<Board>(), 5, [&, &make = makeExecutor](const auto& communicator) {
                auto config = floodConfig(800, make());
                config.gather = gather;
                config.displayRank = 3;
                // The display rank has no tile of its own: 10 MB come to it.
                config.ownerMap = [](int tile, const dfb::TileLayout&, int) { return tile % 4 == 3 ? 4 : tile % 4; };
                AddingFrameBuffer fb(communicator, config);
                for (int i = 0; i < 2; ++i) {
                    auto frame = fb.begin();
                    fb.executor().parallelFor(fb.ownedTiles().size(), [&](std::size_t k) {
                        const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
                        frame.start(*tile, fb.ownedTiles()[k]);
                        fillTile(*tile, 0, 0);
                        frame.setTile(*tile);
                    });
                    const auto r = frame.end();
                    if (fb.isDisplayRank()) {
                        wrong.push_back(wrongSums(fb.image(), 1, 1));
                        report = r;
                        pool = fb.config().messagePoolBytes;
                    }
                }
            });
            CHECK(wrong == std::vector<std::size_t>(2));
            CHECK(report.peakInboxBytes > 0);
            CHECK(report.peakInboxBytes <= static_cast<std::int64_t>(pool));
        }
}

TEST_CASE("A flood in a frame that fails: everybody gets the error, and the next frame is right", "[messaging][flood]")
{
    for (const int ranks : {2, 5})
        for (int culprit = 0; culprit < ranks; culprit += 2) {
            std::vector<std::string> texts(static_cast<std::size_t>(ranks));
            std::size_t wrong = 1;
            std::int64_t peakInbox = 0;
            runOn(std::make_shared<Board>(), ranks, [&](const auto& communicator) {
                auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(2));
                config.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                AddingFrameBuffer fb(communicator, config);
                for (int i = 0; i < 3; ++i) {
                    std::atomic<int> calls{0};
                    texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
                        auto frame = fb.begin();
                        fb.executor().parallelFor(64 * 4, [&](std::size_t k) {
                            if (fb.rank() == culprit && calls++ == 100)
                                frame.abort(std::make_exception_ptr(std::runtime_error("enough")));
                            const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
                            frame.start(*tile, static_cast<int>(k % 64));
                            tile->generation = 1;
                            tile->source = static_cast<std::uint32_t>(fb.rank());
                            tile->part = static_cast<std::uint16_t>(k / 64);
                            fillTile(*tile, 0, 0);
                            frame.setTile(*tile);
                        });
                        frame.end();
                    });
                }
                floodFrame(fb, 2, From::Loop);
                if (fb.isDisplayRank())
                    wrong = wrongSums(fb.image(), ranks, 2);
                const auto report = floodFrame(fb, 2, From::Loop); // what was left of the failed ones is gone by now
                if (fb.isDisplayRank())
                    peakInbox = report.peakInboxBytes;
            });
            INFO("rank " << culprit << joined(texts));
            for (const std::string& text : texts)
                CHECK((text == texts[0] && has(text, "FrameError") && has(text, "enough")
                       && has(text, "rank " + std::to_string(culprit))));
            CHECK(wrong == 0);
            CHECK(peakInbox > 0);
            CHECK(peakInbox <= 1 << 20);
        }
}

TEST_CASE("What comes for a frame that is over does not take up room in the inbox", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    board->inspect = [](int, int, const MessageHeader& header, dfb::Buffer&) {
        return header.kind == MessageKind::Fragment && header.number == 1 ? Board::What::Hold : Board::What::Pass;
    };
    std::vector<std::int64_t> peaks, late;
    std::promise<void> allSet;
    runOn(board, 2, [&](const auto& communicator) {
        auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(1));
        config.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
        AddingFrameBuffer fb(communicator, config);
        const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
        const auto sendOne = [&](AddingFrameBuffer::Frame& frame, int index) {
            frame.start(*tile, index);
            tile->generation = 1;
            fillTile(*tile, 0, 0);
            frame.setTile(*tile);
        };
        dfb::FrameParams params;
        params.declared = true;
        {
            auto frame = fb.begin(params); // left by all
            if (fb.rank() == 1)
                for (int index = 0; index < 30; ++index)
                    sendOne(frame, index);
            if (fb.rank() == 1)
                allSet.set_value();
            else
                allSet.get_future().wait_for(std::chrono::seconds(20));
        }
        fb.allReduce({0}, AddingFrameBuffer::Reduce::Sum);
        if (fb.rank() == 1)
            board->release();
        fb.allReduce({0}, AddingFrameBuffer::Reduce::Sum);
        std::promise<void> tasksDone; // one worker does them in order
        fb.executor().submit([&] { tasksDone.set_value(); });
        tasksDone.get_future().wait();
        for (int i = 0; i < 2; ++i) {
            auto frame = fb.begin(params);
            frame.declare(fb.rank() == 1 ? std::vector<dfb::TileInput>{{3, 1, 0}} : std::vector<dfb::TileInput>());
            if (fb.rank() == 1)
                sendOne(frame, 3);
            const auto report = frame.end();
            if (fb.rank() == 0) {
                peaks.push_back(report.peakInboxBytes);
                late.push_back(report.lateMessages);
            }
        }
    });
    // With the two words of having left.
    CHECK((late.size() == 2 && late[0] >= 30 && late[0] <= 32 && late[1] == 0));
    CHECK(peaks == std::vector<std::int64_t>(2, static_cast<std::int64_t>(fullMessage)));
}

TEST_CASE("A message pool below the largest message's fourfold is raised to it; a larger one stays", "[messaging]")
{
    const Scene s = sceneFor(Loop::Declared);
    std::vector<std::size_t> pools;
    for (const std::size_t bytes : {std::size_t{0}, std::size_t{1} << 20, std::size_t{1} << 21, std::size_t{64} << 20})
        runOn(std::make_shared<Board>(), 2, [&](const auto& communicator) {
            auto config = configOf(s);
            config.messagePoolBytes = bytes;
            FrameBuffer<Blend> fb(communicator, config);
            if (fb.rank() == 0)
                pools.push_back(fb.config().messagePoolBytes);
        });
    CHECK(pools
          == std::vector<std::size_t>{std::size_t{1} << 20, std::size_t{1} << 20, std::size_t{1} << 21,
                                      std::size_t{64} << 20});
    std::size_t large = 0;
    runOn(std::make_shared<Board>(), 1, [&](const auto& communicator) {
        auto config = configOf(s);
        config.messagePoolBytes = 1;
        FrameBuffer<dfb::BasicAlphaBlend<256>> fb(communicator, config);
        large = fb.config().messagePoolBytes;
    });
    CHECK(large == 4 * dfb::detail::largestFragment(256));
}

// ---- several objects on one messenger, several messengers

namespace {

// Two frames open at once, of different operations and images, their calls interleaved; on each rank the images of
// both on their display ranks were right.
template <class A, class B>
bool interleaved(A& a, B& b, const Scene& sa, const Scene& sb, bool endFirst, bool abortB = false)
{
    bool right = true;
    {
        auto frameA = a.begin(scene::paramsOf(sa));
        auto frameB = b.begin(scene::paramsOf(sb));
        const auto tileA = std::make_unique<typename A::Tile>();
        const auto tileB = std::make_unique<typename B::Tile>();
        for (int index : a.ownedTiles()) {
            frameA.start(*tileA, index);
            tileA->children = static_cast<int>(sa.bricks.size());
            frameA.setTile(*tileA);
        }
        const auto mine = scene::bricksOf(sa, a.rank(), a.size());
        for (int index = 0; index < std::max(a.layout().tileCount(), b.layout().tileCount()); ++index) {
            if (index < a.layout().tileCount())
                for (const dfb::Brick& brick : mine) {
                    frameA.start(*tileA, index);
                    tileA->generation = 1;
                    tileA->source = brick.id;
                    scene::renderBrick(sa, brick, *tileA);
                    frameA.setTile(*tileA);
                }
            if (index < b.layout().tileCount() && (index + 1) % b.size() == b.rank()) {
                frameB.start(*tileB, index);
                scene::renderBrick(sb, sb.bricks.front(), *tileB);
                frameB.setTile(*tileB);
            }
            if (abortB && index == 3 && b.rank() == b.size() - 1)
                frameB.abort(std::make_exception_ptr(std::runtime_error("B broke")));
        }
        const auto endA = [&] {
            const auto report = frameA.end();
            right =
                right
                && (!a.isDisplayRank() || scene::wrongValues(Picture(a.image(), report), scene::referenceOf(sa)) == 0);
        };
        const auto endB = [&] {
            const std::string text = outcomeOf([&] {
                const auto report = frameB.end();
                right = right
                        && (!b.isDisplayRank()
                            || scene::wrongValues(Picture(b.image(), report), scene::referenceOf(sb)) == 0);
            });
            right = right && (abortB ? has(text, "FrameError") && has(text, "B broke") : text == "fine");
        };
        if (endFirst)
            endA(), endB();
        else
            endB(), endA();
    }
    return right;
}

using SharedMessenger = dfb::Messenger<BoardTransport>;

} // namespace

TEST_CASE("Frames of two framebuffers on one messenger, open at the same time; one that fails", "[messaging]")
{
    const Scene sa = sceneFor(Loop::Declared, 3);
    Scene sb = scene::makeScene(1, 4, 70, 90);
    sb.bricks[0].bounds = {{0, 0, 0}, {70, 90, 1}};
    for (const int ranks : {1, 2, 5})
        for (const bool shared : {true, false}) // else a messenger each, on one communicator
            for (const bool shuffle : {false, true}) {
                INFO(ranks << " ranks" << (shared ? ", shared" : "") << (shuffle ? ", shuffled" : ""));
                std::vector<std::string> texts(static_cast<std::size_t>(ranks));
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&](const BoardTransport::Communicator& communicator) {
                        const int rank = communicator.inner.rank();
                        const auto messenger = shared ? std::make_shared<SharedMessenger>(communicator)
                                                      : std::shared_ptr<SharedMessenger>();
                        std::unique_ptr<FrameBuffer<Blend>> a;
                        std::unique_ptr<FrameBuffer<dfb::BasicImageParallel<32>>> b;
                        auto configB = configOf(sb);
                        configB.displayRank = ranks - 1;
                        if (shared) {
                            a = std::make_unique<FrameBuffer<Blend>>(messenger, configOf(sa));
                            b = std::make_unique<FrameBuffer<dfb::BasicImageParallel<32>>>(messenger, configB);
                        } else {
                            a = std::make_unique<FrameBuffer<Blend>>(communicator, configOf(sa));
                            b = std::make_unique<FrameBuffer<dfb::BasicImageParallel<32>>>(communicator, configB);
                        }
                        std::string text;
                        for (int i = 0; i < 4; ++i)
                            if (!interleaved(*a, *b, sa, sb, i / 2 == 0, i % 2 == 1))
                                text += "wrong in round " + std::to_string(i) + "; ";
                        // In any order.
                        if (rank % 2 == 0)
                            a.reset(), b.reset();
                        else
                            b.reset(), a.reset();
                        texts[static_cast<std::size_t>(rank)] = text;
                    },
                    shuffle ? std::optional<std::uint64_t>(7) : std::nullopt);
                INFO(joined(texts));
                CHECK(texts == std::vector<std::string>(static_cast<std::size_t>(ranks)));
            }
}

TEST_CASE("A framebuffer made later on one rank gets what came for it before", "[messaging]")
{
    const Scene s = sceneFor(Loop::Declared, 5);
    for (const int late : {0, 2}) { // they hear of 1 and 2, and of 3, before they take part
        const int expected = late == 0 ? 2 : 1;
        const auto board = std::make_shared<Board>();
        std::mutex mutex;
        std::condition_variable changed;
        int came = 0; // messages for the second framebuffer, on the late rank
        bool waiting = true, early = false;
        board->passed = [&](int, int to, const MessageHeader& header) {
            if (to != late || header.receiver != 1)
                return;
            const std::lock_guard<std::mutex> lock(mutex);
            came += waiting;
            changed.notify_all();
        };
        std::vector<std::size_t> wrong;
        runOn(board, 4, [&](const BoardTransport::Communicator& communicator) {
            const auto messenger = std::make_shared<SharedMessenger>(communicator);
            FrameBuffer<Blend> first(messenger, configOf(s));
            if (first.rank() == late) {
                std::unique_lock<std::mutex> lock(mutex);
                early = changed.wait_for(lock, std::chrono::seconds(20), [&] { return came == expected; });
                waiting = false;
            }
            FrameBuffer<Blend> second(messenger, configOf(s));
            for (auto* fb : {&second, &first}) {
                const auto report = scene::renderLoop(*fb, s, Loop::Declared);
                if (fb->isDisplayRank())
                    wrong.push_back(scene::wrongValues(Picture(fb->image(), report), scene::referenceOf(s)));
            }
        });
        INFO("rank " << late);
        CHECK(early);
        CHECK(wrong == std::vector<std::size_t>(2));
    }
}

TEST_CASE("One framebuffer goes while the other has a frame open; another is made after it", "[messaging]")
{
    const Scene s = sceneFor(Loop::Listing3, 6);
    std::size_t wrong = 1;
    runOn(std::make_shared<Board>(), 3, [&](const BoardTransport::Communicator& communicator) {
        const auto messenger = std::make_shared<SharedMessenger>(communicator);
        FrameBuffer<Blend> a(messenger, configOf(s));
        auto b = std::make_unique<FrameBuffer<Single>>(messenger, configOf(s));
        for (int i = 0; i < 3; ++i) {
            auto frame = a.begin(scene::paramsOf(s));
            b.reset();
            b = std::make_unique<FrameBuffer<Single>>(messenger, configOf(s));
            const auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
            for (int index : a.ownedTiles()) {
                frame.start(*tile, index);
                tile->children = static_cast<int>(s.bricks.size());
                frame.setTile(*tile);
            }
            scene::renderLoop(*b, sceneFor(Loop::ImageOwned), Loop::ImageOwned);
            for (const dfb::Brick& brick : scene::bricksOf(s, a.rank(), a.size()))
                for (int index = 0; index < a.layout().tileCount(); ++index) {
                    frame.start(*tile, index);
                    tile->generation = 1;
                    tile->source = brick.id;
                    scene::renderBrick(s, brick, *tile);
                    frame.setTile(*tile);
                }
            const auto report = frame.end();
            if (a.isDisplayRank())
                wrong = scene::wrongValues(Picture(a.image(), report), scene::referenceOf(s));
        }
    });
    CHECK(wrong == 0);
}

// ---- messages twice, and damaged

TEST_CASE("A transport that delivers each message twice: the image is right, and the frame says so", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared, Loop::ImageDealt})
        for (const bool shuffle : {false, true}) {
            const Scene s = sceneFor(loop);
            const auto expected = scene::referenceOf(s);
            const auto board = std::make_shared<Board>();
            board->inspect = [](int, int, const MessageHeader&, dfb::Buffer&) { return Board::What::Twice; };
            std::vector<std::size_t> wrong;
            std::vector<dfb::FrameReport> reports;
            const auto body = [&](auto& fb) {
                for (int i = 0; i < 3; ++i) {
                    const auto report = scene::renderLoop(fb, s, loop);
                    if (fb.isDisplayRank()) {
                        wrong.push_back(scene::wrongValues(Picture(fb.image(), report), expected));
                        reports.push_back(report);
                    }
                }
            };
            runOn(
                board, 3,
                [&](const auto& communicator) {
                    if (scene::isDataParallel(loop)) {
                        FrameBuffer<Blend> fb(communicator, configOf(s));
                        body(fb);
                    } else {
                        FrameBuffer<Single> fb(communicator, configOf(s));
                        body(fb);
                    }
                },
                shuffle ? std::optional<std::uint64_t>(3) : std::nullopt);
            INFO("loop " << static_cast<int>(loop) << (shuffle ? ", shuffled" : ""));
            CHECK(wrong == std::vector<std::size_t>(3));
            for (const dfb::FrameReport& r : reports) {
                CHECK(r.repeatedMessages > 0);
                CHECK(r.lateMessages == 0);
            }
        }
}

TEST_CASE("Repeated messages are counted exactly, and a frame without any has none", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    board->inspect = [](int, int, const MessageHeader& header, dfb::Buffer&) {
        return header.kind == MessageKind::Fragment && header.number == 1 ? Board::What::Twice : Board::What::Pass;
    };
    std::vector<std::int64_t> repeated;
    std::promise<void> setAll;
    std::atomic<int> left{2};
    runOn(board, 3, [&](const auto& communicator) {
        const Scene s = sceneFor(Loop::Listing3);
        auto config = configOf(s);
        config.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
        FrameBuffer<Blend> fb(communicator, config);
        for (int round = 0; round < 2; ++round) {
            auto frame = fb.begin();
            const auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
            if (fb.rank() > 0)
                for (int index = 0; index < 28; ++index) {
                    frame.start(*tile, index);
                    tile->generation = 1;
                    frame.setTile(*tile);
                }
            if (fb.rank() > 0 && round == 0 && --left == 0)
                setAll.set_value(); // whatever comes twice has come
            if (fb.rank() == 0 && round == 0)
                setAll.get_future().wait_for(std::chrono::seconds(20));
            for (int index : fb.ownedTiles()) {
                frame.start(*tile, index);
                tile->children = 2;
                frame.setTile(*tile);
            }
            const auto report = frame.end();
            if (fb.rank() == 0)
                repeated.push_back(report.repeatedMessages);
        }
    });
    CHECK(repeated == std::vector<std::int64_t>{56, 0});
}

TEST_CASE("Copies that come when their frame is long over do no harm", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        const Scene s = sceneFor(loop);
        const auto expected = scene::referenceOf(s);
        const auto board = std::make_shared<Board>();
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
            return header.number == 1 || header.number == 2 ? Board::What::CopyHeld : Board::What::Pass;
        };
        std::vector<std::size_t> wrong;
        std::vector<std::int64_t> late;
        std::size_t copies = 0;
        runOn(board, 3, [&](const BoardTransport::Communicator& communicator) {
            FrameBuffer<Blend> fb(communicator, configOf(s));
            for (int i = 0; i < 4; ++i) {
                fb.allReduce({1}, FrameBuffer<Blend>::Reduce::Sum); // all are out of the frame before
                if (i == 3 && fb.rank() == 1) {
                    copies = board->held.size();
                    board->release();
                }
                const auto report = scene::renderLoop(fb, s, loop);
                if (fb.isDisplayRank()) {
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), expected));
                    late.push_back(report.lateMessages);
                }
            }
        });
        CHECK(wrong == std::vector<std::size_t>(4));
        CHECK(late == std::vector<std::int64_t>(4));
        CHECK(copies > 20);
    }
}

TEST_CASE("With checksums the image is the same", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared, Loop::ImageDealt}) {
        const Scene s = sceneFor(loop);
        std::vector<std::size_t> wrong;
        std::atomic<int> without{0};
        const auto board = std::make_shared<Board>();
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
            without += header.checksum == 0;
            return Board::What::Pass;
        };
        const auto body = [&](auto& fb) {
            for (int i = 0; i < 2; ++i) {
                const auto report = scene::renderLoop(fb, s, loop);
                if (fb.isDisplayRank())
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)));
            }
        };
        runOn(board, 3, [&](const auto& communicator) {
            auto config = configOf(s);
            config.checksums = true;
            if (scene::isDataParallel(loop)) {
                FrameBuffer<Blend> fb(communicator, config);
                body(fb);
            } else {
                FrameBuffer<Single> fb(communicator, config);
                body(fb);
            }
        });
        CHECK(wrong == std::vector<std::size_t>(2));
        CHECK(without == 0);
    }
}

namespace {

// How the second of three frames and the others ended when, with checksums, one byte of one message was changed: the
// first of its kind in that frame. `place` counts from the message's start, or, negative, from its end.
struct Damaged {
    bool done = false;
    std::vector<std::string> before, texts, after;
    std::size_t wrong = 0;
};

Damaged damagedFrame(MessageKind kind, std::uint32_t scope, int place, int timeoutMs)
{
    Damaged result;
    result.before.resize(2);
    result.texts.resize(2);
    result.after.resize(2);
    const auto board = std::make_shared<Board>();
    std::atomic<bool> done{false}, armed{false};
    std::promise<void> mayGoOn;
    const auto mayGoOnFuture = mayGoOn.get_future().share();
    std::atomic<int> notReady{2};
    board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
        const bool isReduction = header.kind == MessageKind::ReduceUp || header.kind == MessageKind::ReduceDown;
        const auto size = static_cast<int>(message.size());
        if (armed && header.kind == kind && place < size && place >= -size
            && (!isReduction || dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) == scope)
            && !done.exchange(true))
            message.data()[place < 0 ? size + place : place] ^= std::byte{0x24};
        return Board::What::Pass;
    };
    Scene s = sceneFor(Loop::Declared);
    runOn(board, 2, [&](const auto& communicator) {
        auto config = configOf(s);
        config.checksums = true;
        FrameBuffer<Blend> fb(communicator, config);
        const auto rank = static_cast<std::size_t>(fb.rank());
        const auto frame = [&](int limit) {
            return outcomeOf([&] {
                Scene timed = s;
                timed.timeoutMs = limit;
                const auto report = scene::renderLoop(fb, timed, Loop::Declared);
                if (fb.isDisplayRank())
                    result.wrong += scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
            });
        };
        result.before[rank] = frame(20000);
        // Nobody is still in that frame, and a message that comes early is for the next.
        armed = true;
        if (--notReady == 0)
            mayGoOn.set_value();
        mayGoOnFuture.wait();
        result.texts[rank] = frame(timeoutMs);
        // After a TransportError there is no other frame, on any rank.
        result.after[rank] = has(result.texts[rank], "TransportError") ? "" : frame(20000);
    });
    result.done = done;
    return result;
}

} // namespace

TEST_CASE("With checksums a changed byte anywhere is an error, never a wrong image", "[messaging]")
{
    enum : std::uint32_t { AllDeclared = 1, FrameVerdict = 2 };
    struct Target {
        const char* name;
        MessageKind kind;
        std::uint32_t scope;
    };
    const std::vector<Target> targets{{"input", MessageKind::Fragment, 0},
                                      {"manifest", MessageKind::Manifest, 0},
                                      {"answer to a manifest", MessageKind::ManifestAck, 0},
                                      {"finished tiles", MessageKind::FinishedTiles, 0},
                                      {"count of finished tiles", MessageKind::TilesDone, 0},
                                      {"all have declared, up", MessageKind::ReduceUp, AllDeclared},
                                      {"all have declared, down", MessageKind::ReduceDown, AllDeclared},
                                      {"vote", MessageKind::ReduceUp, FrameVerdict},
                                      {"verdict", MessageKind::ReduceDown, FrameVerdict}};
    for (const Target& target : targets)
        // Magic number, version, kind, receiver, frame, running number, checksum, the first and the last of the body.
        for (const int place : {0, 2, 3, 4, 8, 16, 20, 24, -1}) {
            if (target.kind == MessageKind::ManifestAck && place == 24)
                continue; // it has no body
            const Damaged d = damagedFrame(target.kind, target.scope, place, 60);
            INFO(target.name << ", byte " << place << joined(d.texts) << "\n after it" << joined(d.after));
            CHECK(d.before == std::vector<std::string>(2, "fine"));
            CHECK(d.done);
            CHECK(d.wrong == 0);
            int errors = 0;
            bool dead = false;
            for (std::size_t rank = 0; rank < 2; ++rank) {
                const std::string& text = d.texts[rank];
                errors += text != "fine";
                dead = dead || has(text, "TransportError");
                CHECK((text == "fine" || has(text, "FrameError: dfb: malformed message")
                       || has(text, "FrameError: dfb: timed out") || has(text, "TransportError")));
            }
            // Who misses the verdict can not fail a frame that the other has seen end well.
            CHECK(errors >= 1);
            if (target.scope != FrameVerdict) {
                CHECK(d.texts[0] == d.texts[1]);
                CHECK_FALSE(dead);
            }
            for (const std::string& text : d.after)
                CHECK((dead ? text.empty() || has(text, "TransportError") : text == "fine"));
        }
}

TEST_CASE("A damaged message that comes before its frame has begun fails that frame on every rank", "[messaging]")
{
    // It comes when its receiver has left the frame before, or when that one has voted and waits for the verdict.
    for (const bool left : {true, false}) {
        const auto board = std::make_shared<Board>();
        std::promise<void> came, isOut;
        std::atomic<bool> done{false}, said{false};
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
            if (header.kind == MessageKind::Fragment && header.number == 2 && !done.exchange(true))
                message.data()[0] ^= std::byte{1}; // no message of dfb any more
            const bool isVerdict = header.kind == MessageKind::ReduceDown && header.number == 1
                                   && dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) == 2;
            return isVerdict && !left ? Board::What::Hold : Board::What::Pass;
        };
        board->passed = [&](int, int, const MessageHeader& header) {
            if (header.kind != MessageKind::Fragment || header.number != 2 || said.exchange(true))
                return;
            came.set_value();
            board->release();
        };
        std::vector<std::string> texts(2);
        std::size_t wrong = 1;
        runOn(
            board, 2,
            [&](const auto& communicator) {
                const Scene s = sceneFor(Loop::Listing3);
                auto config = configOf(s);
                config.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
                FrameBuffer<Blend> fb(communicator, config);
                scene::renderLoop(fb, s, Loop::Listing3);
                if (fb.rank() == 1)
                    isOut.set_value();
                else if (left)
                    isOut.get_future().wait_for(std::chrono::seconds(20));
                if (fb.rank() == 1)
                    came.get_future().wait_for(std::chrono::seconds(20));
                texts[static_cast<std::size_t>(fb.rank())] =
                    outcomeOf([&] { scene::renderLoop(fb, s, Loop::Listing3); });
                const auto report = scene::renderLoop(fb, s, Loop::Listing3);
                if (fb.isDisplayRank())
                    wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
            },
            std::nullopt, std::chrono::seconds(10));
        INFO((left ? "after the frame before" : "within the frame before") << joined(texts));
        CHECK(has(texts[0], "FrameError: dfb: malformed message: rank 1"));
        CHECK(has(texts[0], "from rank 0"));
        CHECK(texts[0] == texts[1]);
        CHECK(wrong == 0);
    }
}

TEST_CASE("Ranks that disagree about checksums get an error each, and none waits for ever", "[messaging]")
{
    for (const int ranks : {2, 4})
        for (int odd = 0; odd < ranks; ++odd)
            for (const bool uses : {false, true}) {
                std::vector<std::string> texts(static_cast<std::size_t>(ranks));
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&](const BoardTransport::Communicator& communicator) {
                        auto config = configOf(sceneFor(Loop::Declared));
                        config.checksums = (communicator.inner.rank() == odd) == uses;
                        texts[static_cast<std::size_t>(communicator.inner.rank())] =
                            outcomeOf([&] { FrameBuffer<Blend> fb(communicator, config); });
                    },
                    std::nullopt, std::chrono::seconds(5));
                INFO("rank " << odd << " of " << ranks << (uses ? " uses them" : " uses none") << joined(texts));
                for (const std::string& text : texts) {
                    CHECK((has(text, "TransportError") || has(text, "InvalidArgument")));
                    CHECK(has(text, "checksum"));
                }
                if (has(texts[0], "time limit"))
                    return; // once is enough
            }
}

TEST_CASE("Ranks that gather differently are refused", "[messaging]")
{
    std::vector<std::string> texts(3);
    runOn(std::make_shared<Board>(), 3, [&](const BoardTransport::Communicator& communicator) {
        auto config = configOf(sceneFor(Loop::Declared));
        if (communicator.inner.rank() == 1)
            config.gather = dfb::GatherMode::AtEnd;
        texts[static_cast<std::size_t>(communicator.inner.rank())] =
            outcomeOf([&] { FrameBuffer<Blend> fb(communicator, config); });
    });
    INFO(joined(texts));
    for (const std::string& text : texts)
        CHECK((has(text, "InvalidArgument") && text == texts[0]));
}

// ---- gathering

TEST_CASE("Gathering at the end gives the same image bit for bit, also after frames that failed", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        std::map<dfb::GatherMode, std::vector<std::uint64_t>> hashes;
        std::map<dfb::GatherMode, std::vector<std::string>> failures;
        for (const auto gather : {dfb::GatherMode::Batches, dfb::GatherMode::AtEnd})
            runOn(std::make_shared<Board>(), 4, [&](const auto& communicator) {
                const Scene s = sceneFor(loop, 8);
                auto config = configOf(s, 2);
                config.gather = gather;
                config.displayRank = 1;
                FrameBuffer<Blend> fb(communicator, config);
                for (int i = 0; i < 6; ++i) {
                    if (i % 2 == 1) {
                        // Most tiles are finished, and in a message, when it fails.
                        const std::string text = outcomeOf([&] {
                            auto frame = fb.begin();
                            const auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
                            for (std::size_t k = 0; k < fb.ownedTiles().size(); ++k) {
                                if (fb.rank() == i / 2 && k + 1 == fb.ownedTiles().size()) {
                                    frame.abort(std::make_exception_ptr(std::runtime_error("enough")));
                                    break;
                                }
                                frame.start(*tile, fb.ownedTiles()[k]);
                                const float colour[4] = {9, 9, 9, 1};
                                tile->fill(colour, 0.0f);
                                frame.setTile(*tile);
                            }
                            frame.end();
                        });
                        if (fb.isDisplayRank())
                            failures[gather].push_back(text);
                        continue;
                    }
                    Scene round = s;
                    round.background[1] = static_cast<float>(i);
                    const auto report = scene::renderLoop(fb, round, loop);
                    if (fb.isDisplayRank()) {
                        const Picture p(fb.image(), report);
                        CHECK(scene::wrongValues(p, scene::referenceOf(round)) == 0);
                        hashes[gather].push_back(p.hash());
                    }
                }
            });
        CHECK(hashes[dfb::GatherMode::Batches].size() == 3);
        CHECK(hashes[dfb::GatherMode::Batches] == hashes[dfb::GatherMode::AtEnd]);
        for (const auto& [gather, texts] : failures) {
            CHECK(texts.size() == 3);
            for (const std::string& text : texts)
                CHECK(has(text, "enough"));
        }
    }
}

TEST_CASE("Gathering at the end: nothing leaves for the display rank before a rank's last tile", "[messaging]")
{
    for (const auto gather : {dfb::GatherMode::Batches, dfb::GatherMode::AtEnd}) {
        const auto board = std::make_shared<Board>();
        std::atomic<int> batches{0}, batchesThen{-1};
        std::promise<void> first;
        std::atomic<bool> seen{false};
        board->passed = [&](int, int, const MessageHeader& header) {
            if (header.kind != MessageKind::FinishedTiles)
                return;
            ++batches;
            if (!seen.exchange(true))
                first.set_value();
        };
        std::size_t wrong = 1;
        runOn(board, 2, [&](const auto& communicator) {
            auto config = floodConfig(512, std::make_shared<dfb::ThreadExecutor>(1)); // 16 tiles a batch
            config.gather = gather;
            config.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
            AddingFrameBuffer fb(communicator, config);
            auto frame = fb.begin();
            const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
            for (std::size_t k = 0; k < fb.ownedTiles().size(); ++k) {
                if (k + 1 == fb.ownedTiles().size()) {
                    if (gather == dfb::GatherMode::Batches)
                        first.get_future().wait_for(std::chrono::seconds(20)); // they do leave before
                    std::promise<void> finished;                               // tasks of one worker are done in order
                    fb.executor().submit([&] { finished.set_value(); });
                    finished.get_future().wait();
                    batchesThen = batches.load();
                }
                frame.start(*tile, fb.ownedTiles()[k]);
                fillTile(*tile, 0, 0);
                frame.setTile(*tile);
            }
            frame.end();
            if (fb.isDisplayRank())
                wrong = wrongSums(fb.image(), 1, 1);
        });
        CHECK(wrong == 0);
        CHECK((gather == dfb::GatherMode::AtEnd ? batchesThen == 0 : batchesThen > 0));
        CHECK(batches >= 16);
    }
}

TEST_CASE("Gathering at the end: nothing of a frame that failed is sent later", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    std::atomic<int> ofFirst{0}, ofSecond{0};
    board->passed = [&](int, int, const MessageHeader& header) {
        if (header.kind == MessageKind::FinishedTiles)
            ++(header.number == 1 ? ofFirst : ofSecond);
    };
    std::size_t wrong = 1;
    runOn(board, 2, [&](const auto& communicator) {
        auto config = floodConfig(512, std::make_shared<dfb::ThreadExecutor>(1)); // 16 tiles a batch
        config.gather = dfb::GatherMode::AtEnd;
        config.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
        AddingFrameBuffer fb(communicator, config);
        for (const bool good : {false, true}) {
            const std::string text = outcomeOf([&] {
                auto frame = fb.begin();
                const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
                for (std::size_t k = 0; k < fb.ownedTiles().size(); ++k) {
                    if (!good && k == 100) {
                        std::promise<void> finished; // tasks of one worker are done in order
                        fb.executor().submit([&] { finished.set_value(); });
                        finished.get_future().wait();
                        frame.abort(std::make_exception_ptr(std::runtime_error("enough")));
                    }
                    frame.start(*tile, fb.ownedTiles()[k]);
                    fillTile(*tile, 0, 0);
                    frame.setTile(*tile);
                }
                frame.end();
            });
            if (fb.isDisplayRank() && good && text == "fine")
                wrong = wrongSums(fb.image(), 1, 1);
        }
    });
    CHECK(wrong == 0);
    CHECK(ofFirst == 0);
    CHECK(ofSecond >= 16);
}

// ---- progress by the caller

namespace {

// Counts the inputs that it has been given, on all ranks.
std::atomic<int> inputsAdded{0};
struct Counter : dfb::BasicAlphaBlend<16> {
    void add(dfb::Fragment&& fragment)
    {
        BasicAlphaBlend::add(std::move(fragment));
        ++inputsAdded;
    }
};

} // namespace

TEST_CASE("With progress by the caller messages move in poll(), and not without it", "[messaging]")
{
    for (const std::uint64_t seed : {1u, 2u, 3u}) {
        std::promise<void> sent;
        int before = -1, after = -1;
        bool moved = false;
        std::vector<std::size_t> wrong;
        inputsAdded = 0;
        const Scene s = sceneFor(Loop::Listing3);
        runOn(
            std::make_shared<Board>(), 2,
            [&](const BoardTransport::Communicator& communicator) {
                auto config = configOf(s);
                config.progress = dfb::Progress::Caller;
                config.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                FrameBuffer<Counter> fb(communicator, config);
                {
                    auto frame = fb.begin(scene::paramsOf(s));
                    const auto tile = std::make_unique<FrameBuffer<Counter>::Tile>();
                    if (fb.rank() == 1) {
                        for (const dfb::Brick& brick : s.bricks)
                            for (int index = 0; index < 28; ++index) {
                                frame.start(*tile, index);
                                tile->generation = 1;
                                tile->source = brick.id;
                                scene::renderBrick(s, brick, *tile);
                                frame.setTile(*tile);
                            }
                        sent.set_value();
                    } else {
                        sent.get_future().wait_for(std::chrono::seconds(20));
                        std::promise<void> tasksDone; // the one worker does them in order
                        fb.executor().submit([&] { tasksDone.set_value(); });
                        tasksDone.get_future().wait();
                        before = inputsAdded;
                        const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(20);
                        while (inputsAdded < 28 * 6 && std::chrono::steady_clock::now() < limit)
                            moved = fb.poll() || moved;
                        after = inputsAdded;
                        for (int index : fb.ownedTiles()) {
                            frame.start(*tile, index);
                            tile->children = 6;
                            frame.setTile(*tile);
                        }
                    }
                    const auto report = frame.end();
                    if (fb.isDisplayRank())
                        wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)));
                }
                const auto report = scene::renderLoop(fb, s, Loop::Declared);
                if (fb.isDisplayRank())
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)));
            },
            seed);
        CHECK(before == 0);
        CHECK(after == 28 * 6);
        CHECK(moved);
        CHECK(wrong == std::vector<std::size_t>(2));
    }
}

TEST_CASE("A flood with progress by the caller: setTile() makes the progress that it waits for", "[messaging][flood]")
{
    for (const int ranks : {2, 4})
        for (const From from : {From::Thread, From::Loop})
            for (const bool toOne : {true, false}) {
                std::size_t wrong = 1;
                dfb::FrameReport report;
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&](const auto& communicator) {
                        auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(2));
                        config.progress = dfb::Progress::Caller;
                        if (toOne)
                            config.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                        AddingFrameBuffer fb(communicator, config);
                        const auto r = floodFrame(fb, 3, from);
                        if (fb.isDisplayRank()) {
                            wrong = wrongSums(fb.image(), ranks, 3);
                            report = r;
                        }
                    },
                    5);
                INFO(ranks << " ranks" << (toOne ? ", to one" : "") << (from == From::Loop ? ", from a loop" : ""));
                CHECK(wrong == 0);
                CHECK(report.peakInboxBytes <= 1 << 20);
            }
}
