// BoundedServer: cpp-httplib's server with limits that it lacks: on the size of a request, on the time that a request
// and its answer may take, and on the number of connections.
#pragma once

#include <httplib.h>

#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <functional>
#include <mutex>
#include <set>
#include <string>
#include <utility>

namespace example {

class BoundedServer : public httplib::Server {
public:
    static constexpr std::size_t mostRequestBytes = 24 << 10; // including its headers
    static constexpr std::size_t mostConnections = 48;        // served at once; the system queues others
    static constexpr std::chrono::seconds mostRequestTime{5}, mostAnswerTime{5}, mostIdleTime{2};

    BoundedServer()
    {
        new_task_queue = [] { return new Workers(mostConnections); };
        set_keep_alive_max_count(1000000);
        set_tcp_nodelay(true);
        // Replaces the default, SO_REUSEPORT, with which a second job would share the port of the first.
        set_socket_options([](socket_t socket) {
            const int yes = 1;
            setsockopt(socket, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
        });
    }

    // Called by a handler: ends the connection after this answer, so that one that waits is served.
    static void endAfter(httplib::Response& response)
    {
        response.set_header("Connection", "close");
        isLast = true;
    }

    // Ends all connections. First waits up to `least` for clients to end theirs, while requests are still answered;
    // then, until `most` has passed in all, for answers that are under way. Any thread.
    void hangUp(std::chrono::milliseconds least, std::chrono::milliseconds most)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        ended_.wait_for(lock, least, [&] { return open_.empty(); });
        ended_.wait_for(lock, most - least, [&] { return answering_ == 0; });
        isHangingUp_ = true;
        for (const socket_t socket : open_)
            ::shutdown(socket, SHUT_RDWR);
    }

private:
    using Clock = std::chrono::steady_clock;
    inline static thread_local bool isLast = false; // the answer of this thread, which serves one connection at a time

    // A thread for each connection. While all are busy no connection is accepted: otherwise the job could run out of
    // file descriptors.
    class Workers : public httplib::ThreadPool {
    public:
        using ThreadPool::ThreadPool;

        void enqueue(std::function<void()> work) override
        {
            std::unique_lock<std::mutex> lock(mutex_);
            ended_.wait(lock, [&] { return open_ < mostConnections; });
            ++open_;
            ThreadPool::enqueue([this, work = std::move(work)] {
                work();
                const std::lock_guard<std::mutex> guard(mutex_);
                --open_;
                ended_.notify_one();
            });
        }

    private:
        std::mutex mutex_;
        std::condition_variable ended_;
        std::size_t open_ = 0;
    };

    // A request and its answer.
    class Exchange : public httplib::Stream {
    public:
        explicit Exchange(socket_t socket) : socket_(socket) {}

        // Waits for the first byte of a request; false if there will be none.
        bool begin()
        {
            left_ = mostRequestBytes;
            line_.clear();
            writeUntil_ = {};
            readUntil_ = Clock::now() + mostIdleTime;
            const bool isThere = at_ < end_ || waitFor(POLLIN, readUntil_);
            readUntil_ = Clock::now() + mostRequestTime;
            return isThere;
        }

        bool is_readable() const override { return at_ < end_ || waitFor(POLLIN, readUntil_); }
        bool is_writable() const override { return true; } // write() waits itself

        ssize_t read(char* to, std::size_t size) override
        {
            if (at_ == end_) {
                if (!waitFor(POLLIN, readUntil_))
                    return -1;
                const ssize_t got = ::recv(socket_, buffer_.data(), buffer_.size(), MSG_DONTWAIT);
                if (got <= 0)
                    return got;
                at_ = 0;
                end_ = static_cast<std::size_t>(got);
            }
            const std::size_t count = std::min(size, end_ - at_);
            if (count > left_)
                return -1;
            left_ -= count;
            std::copy_n(buffer_.data() + at_, count, to);
            at_ += count;
            return std::any_of(to, to + count, [this](char c) { return asksForRanges(c); })
                       ? -1
                       : static_cast<ssize_t>(count);
        }

        ssize_t write(const char* from, std::size_t size) override
        {
            if (writeUntil_ == Clock::time_point{})
                writeUntil_ = Clock::now() + mostAnswerTime;
            std::size_t sent = 0;
            while (sent < size) {
                const ssize_t now = ::send(socket_, from + sent, size - sent, MSG_DONTWAIT | MSG_NOSIGNAL);
                if (now >= 0)
                    sent += static_cast<std::size_t>(now);
                else if ((errno != EAGAIN && errno != EINTR) || !waitFor(POLLOUT, writeUntil_))
                    return -1;
            }
            return static_cast<ssize_t>(size);
        }

        void get_remote_ip_and_port(std::string& ip, int& port) const override
        {
            ip.clear();
            port = 0;
        }
        void get_local_ip_and_port(std::string& ip, int& port) const override
        {
            ip.clear();
            port = 0;
        }
        socket_t socket() const override { return socket_; }

    private:
        // Whether `next` completes the name of the header `Range:`, which our page does not send. cpp-httplib parses a
        // list of ranges by recursion, with 500 bytes of stack a character, and copies the answer for each range.
        bool asksForRanges(char next)
        {
            if (next == '\n')
                line_.clear();
            else if (line_.size() < 7)
                line_ += static_cast<char>(std::tolower(static_cast<unsigned char>(next)));
            return line_ == "range:";
        }

        bool waitFor(short event, Clock::time_point until) const
        {
            for (;;) {
                const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(until - Clock::now()).count();
                pollfd wanted{socket_, event, 0};
                const int ready = ::poll(&wanted, 1, static_cast<int>(std::max<long long>(0, left)));
                if (ready > 0)
                    return (wanted.revents & event) != 0;
                if (ready == 0 || errno != EINTR)
                    return false;
            }
        }

        socket_t socket_;
        std::array<char, 4096> buffer_{};
        std::size_t at_ = 0, end_ = 0, left_ = 0;
        std::string line_; // the first characters of a line of the request
        Clock::time_point readUntil_, writeUntil_;
    };

    bool process_and_close_socket(socket_t socket) override
    {
        bool isWelcome = false;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            isWelcome = !isHangingUp_;
            if (isWelcome)
                open_.insert(socket);
        }
        bool isWell = isWelcome, isClosed = false;
        Exchange exchange(socket);
        while (isWell && !isClosed && exchange.begin()) {
            countAnswers(1);
            isLast = false;
            isWell = process_request(exchange, false, isClosed, nullptr) && !isLast;
            countAnswers(-1);
        }
        const std::lock_guard<std::mutex> lock(mutex_);
        open_.erase(socket);
        ended_.notify_all();
        ::shutdown(socket, SHUT_RDWR);
        ::close(socket);
        return isWell;
    }

    void countAnswers(int change)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        answering_ += change;
        ended_.notify_all();
    }

    std::mutex mutex_;
    std::condition_variable ended_; // a connection or an answer has ended
    std::set<socket_t> open_;
    int answering_ = 0;
    bool isHangingUp_ = false;
};

} // namespace example
