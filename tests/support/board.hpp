// A board through which all messages of in-process ranks pass. Tests use it to watch messages, hold them back, lose,
// repeat or change them. runOn() also sets a time limit for everything that runs over a board.
#pragma once

#include "forward.hpp"
#include "shuffled.hpp"
#include "undisturbed.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <future>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace board {

using dfb::detail::MessageHeader;

// Decides what happens to the messages of all ranks, and makes all ranks fail when the time is up.
struct Board {
    enum class What { Pass, Hold, Lose, Twice, CopyHeld };
    // Called for each message to another rank, from any thread.
    std::function<What(int from, int to, const MessageHeader&, dfb::Buffer&)> inspect;
    // Called after a message has been passed on.
    std::function<void(int from, int to, const MessageHeader&)> passed;

    std::atomic<std::int64_t> sent{0}; // messages
    std::mutex mutex;
    std::vector<std::function<void()>> held;
    bool released = false;
    std::map<int, dfb::TransportHandler*> handlers; // by rank
    std::atomic<bool> timeIsUp{false};
    std::shared_ptr<dfb::MemoryPool> pool = dfb::MemoryPool::create();

    // Keeps `send` until release() is called; after that, calls it at once.
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
    // Every rank that is waiting gets a TransportError.
    void giveUp()
    {
        timeIsUp = true;
        const std::lock_guard<std::mutex> lock(mutex);
        for (const auto& [rank, handler] : handlers) {
            dfb::ErrorInfo info;
            info.kind = dfb::ErrorKind::Transport;
            info.message = "the test's time limit";
            handler->fail(info);
        }
    }
};

class BoardTransport : public Forward<ShuffledTransport> {
public:
    struct Communicator {
        ShuffledTransport::Communicator inner;
        std::shared_ptr<Board> board;
    };

    BoardTransport(const Communicator& c, std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress)
        : Forward(c.inner, std::move(pool), progress), board_(c.board)
    {
    }
    void start(dfb::TransportHandler& handler)
    {
        {
            const std::lock_guard<std::mutex> lock(board_->mutex);
            board_->handlers[inner_.rank()] = &handler;
        }
        inner_.start(handler);
    }
    void stop(bool orderly)
    {
        {
            const std::lock_guard<std::mutex> lock(board_->mutex);
            board_->handlers.erase(inner_.rank());
        }
        inner_.stop(orderly);
    }
    void send(int to, dfb::Buffer&& message)
    {
        ++board_->sent;
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
};

// Calls runRanks() over a board and gives up after `limit`. Throws std::runtime_error if an exception leaves runRanks()
// or if time was up. Does not use Catch, so several may run at once.
inline void runOn(const std::shared_ptr<Board>& board, int ranks,
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
        dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) { body({{communicator, shuffleSeed}, board}); });
    } catch (const std::exception& e) {
        thrown = e.what();
    }
    done.set_value();
    watch.join();
    if (board->timeIsUp)
        thrown += " (time was up)";
    if (!thrown.empty())
        throw std::runtime_error(thrown);
}

// Runs all items at the same time, each on a thread of its own, as most of them wait most of the time. Runs all of them
// again if the process stood still meanwhile. Then checks the results one by one. `run(item)` must not use Catch;
// `check(item, result)` may.
template <class Item, class Run, class Check>
void eachAtOnce(const std::vector<Item>& items, const Run& run, const Check& check)
{
    const auto results = undisturbed([&] {
        std::vector<std::future<decltype(run(items.front()))>> running;
        for (const Item& item : items)
            running.push_back(std::async(std::launch::async, [&run, &item] { return run(item); }));
        std::vector<decltype(run(items.front()))> all;
        for (auto& one : running)
            all.push_back(one.get());
        return all;
    });
    for (std::size_t i = 0; i < items.size(); ++i)
        check(items[i], results[i]);
}

inline std::string joined(const std::vector<std::string>& texts)
{
    std::string all;
    for (const std::string& t : texts)
        all += "\n  " + t;
    return all;
}

inline bool allSame(const std::vector<std::string>& texts)
{
    return std::all_of(texts.begin(), texts.end(), [&](const std::string& t) { return t == texts.front(); });
}

} // namespace board
