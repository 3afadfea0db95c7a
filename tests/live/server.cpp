// LiveView without a job: its answers, and that no viewer can harm or slow the job.
#include "catch.hpp"
#include "undisturbed.hpp"

#include <live_view.hpp>

#include <httplib.h>
#include <nlohmann/json.hpp>
#include <png.h>
#include <turbojpeg.h>

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <iterator>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace live_server {

using nlohmann::json;
using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;
using std::chrono::seconds;

// RGBA noise, which does not compress.
std::vector<std::uint8_t> pixelsOf(int width, int height, int shade)
{
    std::vector<std::uint8_t> pixels(4 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height), 255);
    std::uint32_t noise = 12345;
    for (std::size_t i = 0; i < pixels.size() / 4; ++i) {
        noise = noise * 1664525u + 1013904223u;
        pixels[4 * i] = static_cast<std::uint8_t>(noise >> 24);
        pixels[4 * i + 1] = static_cast<std::uint8_t>(noise >> 16);
        pixels[4 * i + 2] = static_cast<std::uint8_t>((noise >> 8) + static_cast<std::uint32_t>(shade));
    }
    return pixels;
}

// A LiveView with a scene, on any free port.
struct Fixture {
    explicit Fixture(bool hasSteps = true) : made(example::LiveView::listen("a title", 0, hasSteps)), view(*made)
    {
        example::LiveScene scene;
        scene.mostSamples = 64;
        example::LiveWishes home;
        home.camera = {30, 20, 2, {1, 2, 3}};
        home.width = 320;
        home.height = 200;
        view.open(scene, home);
        const std::string& url = view.url();
        port = std::atoi(url.c_str() + url.rfind(':') + 1);
        token = url.substr(url.find("token=") + 6);
    }

    httplib::Client client() const
    {
        httplib::Client to("127.0.0.1", port);
        to.set_read_timeout(20);
        return to;
    }
    std::string path(const std::string& name, const std::string& more = "") const
    {
        return name + "?token=" + token + more;
    }
    int get(const std::string& target) const
    {
        const auto answer = client().Get(target);
        return answer ? answer->status : -1;
    }
    int post(const std::string& name, const std::string& body) const
    {
        const auto answer = client().Post(path(name), body, "application/json");
        return answer ? answer->status : -1;
    }
    example::LiveWishes wishes() const { return view.waitForChange(0, std::chrono::milliseconds(0)); }
    void show(int width = 320, int height = 200, int shade = 0)
    {
        example::LivePicture picture;
        picture.wishes = wishes();
        picture.tileSize = 64;
        picture.owners.assign(static_cast<std::size_t>((width + 63) / 64 * ((height + 63) / 64)), 1);
        view.show(pixelsOf(width, height, shade).data(), width, height, {}, picture);
    }

    std::unique_ptr<example::LiveView> made;
    example::LiveView& view;
    int port = 0;
    std::string token;
};

// A TCP connection that sends and receives raw bytes.
class Socket {
public:
    explicit Socket(int port) : fd_(::socket(AF_INET, SOCK_STREAM, 0))
    {
        const timeval limit{20, 0};
        const int room = 1 << 16;
        setsockopt(fd_, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
        setsockopt(fd_, SOL_SOCKET, SO_SNDTIMEO, &limit, sizeof limit);
        setsockopt(fd_, SOL_SOCKET, SO_RCVBUF, &room, sizeof room);
        sockaddr_in to{};
        to.sin_family = AF_INET;
        to.sin_port = htons(static_cast<std::uint16_t>(port));
        to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        isOpen_ = ::connect(fd_, reinterpret_cast<const sockaddr*>(&to), sizeof to) == 0;
    }
    ~Socket() { ::close(fd_); }
    Socket(const Socket&) = delete;
    Socket& operator=(const Socket&) = delete;

    int fd() const { return fd_; }
    bool isOpen() const { return isOpen_; }
    // Returns false if the other side has closed the connection.
    bool send(const std::string& bytes) const
    {
        std::size_t sent = 0;
        while (sent < bytes.size()) {
            const ssize_t now = ::send(fd_, bytes.data() + sent, bytes.size() - sent, MSG_NOSIGNAL);
            if (now <= 0)
                return false;
            sent += static_cast<std::size_t>(now);
        }
        return true;
    }
    // Returns all bytes until the other side closes the connection.
    std::string receiveAll() const
    {
        std::string all;
        char some[4096];
        for (ssize_t got = 0; (got = ::recv(fd_, some, sizeof some, 0)) > 0;)
            all.append(some, static_cast<std::size_t>(got));
        return all;
    }

private:
    int fd_;
    bool isOpen_;
};

long peakMemoryKb()
{
    rusage usage{};
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_maxrss;
}

TEST_CASE("a live view listens on the loopback address alone, with a new token each time")
{
    const Fixture one, other;
    CHECK(one.view.url().rfind("http://127.0.0.1:", 0) == 0);
    CHECK(one.token.size() == 32);
    CHECK(one.token != other.token);
    CHECK(one.port != other.port);
    const std::string port = std::to_string(one.port);
    CHECK(one.view.invitation().find(": " + one.view.url() + '\n') != std::string::npos);
    CHECK(one.view.invitation().find("ssh -L " + port + ":127.0.0.1:" + port + ' ') != std::string::npos);
    std::string why;
    try {
        example::LiveView::listen("second", one.port, false);
    } catch (const std::runtime_error& e) {
        why = e.what();
    }
    CHECK(why.find("port " + std::to_string(one.port)) != std::string::npos);
}

TEST_CASE("a live view answers nobody without the token")
{
    Fixture f;
    f.show();
    std::string almost = f.token;
    almost.back() = almost.back() == '0' ? '1' : '0';
    for (const std::string& wrong : {std::string(), std::string("?token="), "?token=" + almost,
                                     "?token=" + f.token.substr(0, 31), "?token=" + f.token + "0", "?Token=" + f.token})
        for (const char* name : {"/", "/frame", "/picture.png", "/stats", "/camera", "/nothing"}) {
            INFO(name << wrong);
            CHECK(f.get(name + wrong) == 403);
            const auto answer = f.client().Post(name + wrong, R"({"command": "end", "azimuth": 1})", "text/plain");
            REQUIRE(answer);
            CHECK(answer->status == 403);
        }
    CHECK(f.wishes().number == 0);
    CHECK(f.wishes().ends == 0);
    CHECK(f.get(f.path("/")) == 200);
    CHECK(f.get(f.path("/nothing")) == 404);
    const Socket socket(f.port);
    REQUIRE(socket.send("GET /stats HTTP/1.1\r\nHost: x\r\n\r\n"));
    const auto start = std::chrono::steady_clock::now();
    CHECK(socket.receiveAll().rfind("HTTP/1.1 403", 0) == 0); // until the connection ends, which keeps no thread
    CHECK(std::chrono::steady_clock::now() - start < std::chrono::seconds(2)); // after which idle ones end
}

TEST_CASE("a live view gives pictures back as they were shown")
{
    Fixture f;
    CHECK(f.get(f.path("/picture.png")) == 404);
    f.show(100, 70, 9);
    f.show(101, 71, 10);
    const auto png = f.client().Get(f.path("/picture.png"));
    REQUIRE(png);
    CHECK(png->get_header_value("X-Frame") == "2");
    png_image image{};
    image.version = PNG_IMAGE_VERSION;
    REQUIRE(png_image_begin_read_from_memory(&image, png->body.data(), png->body.size()) != 0);
    CHECK(image.width == 101);
    CHECK(image.height == 71);
    CHECK((image.format & PNG_FORMAT_FLAG_ALPHA) == 0);
    image.format = PNG_FORMAT_RGBA;
    std::vector<std::uint8_t> pixels(PNG_IMAGE_SIZE(image));
    REQUIRE(png_image_finish_read(&image, nullptr, pixels.data(), 0, nullptr) != 0);
    CHECK(pixels == pixelsOf(101, 71, 10));

    const auto jpeg = f.client().Get(f.path("/frame", "&after=1&quality=90"));
    REQUIRE(jpeg);
    CHECK(jpeg->get_header_value("Content-Type") == "image/jpeg");
    const std::unique_ptr<void, int (*)(void*)> decoder(tjInitDecompress(), tjDestroy);
    int width = 0, height = 0, sampling = 0, colours = 0;
    CHECK(tjDecompressHeader3(decoder.get(), reinterpret_cast<const unsigned char*>(jpeg->body.data()),
                              static_cast<unsigned long>(jpeg->body.size()), &width, &height, &sampling, &colours)
          == 0);
    CHECK(width == 101);
    CHECK(height == 71);
}

// For undisturbed(): on a busy machine it may take long, but not each time.
const auto takesLong = [](bool, const auto& took) { return took.get() >= seconds(4); };

TEST_CASE("a request for a picture waits for one that is newer")
{
    std::string number;
    const auto took = undisturbed(
        [&] {
            Fixture f;
            f.show();
            std::thread viewer([&] {
                const auto answer = f.client().Get(f.path("/frame", "&after=1"));
                number = answer ? answer->get_header_value("X-Frame") : "none";
            });
            while (json::parse(f.client().Get(f.path("/stats"))->body)["waiting"] != 1)
                std::this_thread::yield();
            const auto begin = Clock::now();
            f.show();
            viewer.join();
            return Clock::now() - begin;
        },
        takesLong);
    CHECK(number == "2");
    CHECK(took < seconds(4)); // the viewer is told at once, not only when its wait ends
}

TEST_CASE("what viewers want reaches the job, and nonsense does not")
{
    Fixture f;
    CHECK(f.post("/camera", R"({"azimuth": 12.5, "elevation": -3, "width": 640, "height": 480})") == 200);
    example::LiveWishes wishes = f.wishes();
    CHECK(wishes.number == 1);
    CHECK(wishes.look == 1);
    CHECK(wishes.camera.azimuth == 12.5);
    CHECK(wishes.camera.elevation == -3);
    CHECK(wishes.camera.distance == 2); // unchanged
    CHECK(wishes.width == 640);
    CHECK(wishes.height == 480);
    CHECK(f.post("/camera", R"({"azimuth": 12.5})") == 200); // no change
    CHECK(f.wishes().number == 1);
    CHECK(f.post("/camera", R"({"samples": 4, "target": [1, 2, 3.5]})") == 200);
    CHECK(f.wishes().samples == 4);
    CHECK(f.wishes().camera.target[2] == 3.5);
    CHECK(f.view.hasMoved(1, false));
    CHECK_FALSE(f.view.hasMoved(2, false));
    CHECK_FALSE(f.view.hasMoved(1, true));
    CHECK(f.post("/command", R"({"command": "step"})") == 200);
    CHECK(f.wishes().isPaused == 1);
    CHECK(f.wishes().steps == 1);
    CHECK(f.wishes().look == 2);

    const std::uint64_t before = f.wishes().number;
    for (const char* body : {"",
                             "{",
                             "[]",
                             "1",
                             "null",
                             R"({"azimuth": "1"})",
                             R"({"azimuth": null})",
                             R"({"azimuth": 1e999})",
                             R"({"azimuth": 40000})",
                             R"({"elevation": 90.1})",
                             R"({"distance": -1})",
                             R"({"distance": 1001})",
                             R"({"width": 15})",
                             R"({"width": 4097})",
                             R"({"height": 1e30})",
                             R"({"samples": 0})",
                             R"({"samples": 65})",
                             R"({"target": 1})",
                             R"({"target": [1, 2]})",
                             R"({"target": [1, 2, "3"]})",
                             R"({"target": [1, 2, 1e9]})",
                             R"({"azimuth": 5, "width": 1})"}) {
        INFO(body);
        CHECK(f.post("/camera", body) == 400);
    }
    for (const char* body : {"{}", R"({"command": "stop"})", R"({"command": 1})", R"({"command": null})"}) {
        INFO(body);
        CHECK(f.post("/command", body) == 400);
    }
    CHECK(f.wishes().number == before);
    for (const char* query : {"&after=-1", "&after=x", "&after=9999999999999999999", "&quality=9", "&quality=101"}) {
        INFO(query);
        CHECK(f.get(f.path("/frame", query)) == 400);
    }
    Fixture still(false);
    CHECK(still.post("/command", R"({"command": "pause"})") == 400);
    CHECK(still.post("/command", R"({"command": "end"})") == 200);
    CHECK(still.wishes().ends == 1);
}

TEST_CASE("a job that waits for its viewers hears them")
{
    Fixture f;
    const auto begin = Clock::now();
    CHECK(f.view.waitForChange(0, milliseconds(50)).number == 0);
    CHECK(Clock::now() - begin >= milliseconds(50));
    std::thread viewer([&] { f.post("/camera", R"({"azimuth": 1})"); });
    CHECK(f.view.waitForChange(0, milliseconds::max()).number == 1);
    viewer.join();

    // While the job works, it is told once, also of wishes that came before.
    int told = 0;
    f.view.whileWatching(
        1, false, [&] { ++told; },
        [&] {
            CHECK(told == 0);
            CHECK(f.post("/camera", R"({"samples": 9})") == 200); // nothing moves
            CHECK(told == 0);
            CHECK(f.post("/camera", R"({"azimuth": 2})") == 200);
            CHECK(told == 1);
            CHECK(f.post("/camera", R"({"azimuth": 3})") == 200);
            CHECK(told == 1);
        });
    f.view.whileWatching(
        1, false, [&] { ++told; }, [&] { CHECK(told == 2); });
    CHECK(f.post("/camera", R"({"azimuth": 4})") == 200);
    CHECK(told == 2);
    const auto looksAt = [&](const char* wish) {
        CHECK(f.post("/camera", wish) == 200);
        return f.wishes().look;
    };
    f.view.whileWatching(
        looksAt(R"({"width": 640, "height": 480})"), true, [&] { ++told; },
        [&] {
            looksAt(R"({"azimuth": 5})");
            looksAt(R"({"width": 800})");
            CHECK(told == 2);
            looksAt(R"({"width": 320, "height": 240})");
            CHECK(told == 3);
        });
    f.view.whileWatching(
        f.wishes().look, true, [&] { ++told; },
        [&] {
            looksAt(R"({"azimuth": 6})");
            CHECK(told == 3);
            CHECK(f.post("/command", R"({"command": "end"})") == 200);
            CHECK(told == 4);
        });
}

TEST_CASE("requests and bodies have limits")
{
    Fixture f;
    const long before = peakMemoryKb();
    CHECK(f.post("/camera", std::string(4097, ' ')) == 413);
    CHECK(f.post("/camera", std::string(1 << 20, ' ')) != 200);
    const std::string head = "POST " + f.path("/camera") + " HTTP/1.1\r\nHost: x\r\n";
    {
        const Socket socket(f.port);
        REQUIRE(socket.send(head + "Transfer-Encoding: chunked\r\n\r\n1400\r\n" + std::string(0x1400, ' ')
                            + "\r\n0\r\n\r\n"));
        CHECK(socket.receiveAll().rfind("HTTP/1.1 413", 0) == 0);
    }
    const auto form = f.client().Post(f.path("/camera"), "--x--\r\n", "multipart/form-data; boundary=x");
    REQUIRE(form);
    CHECK(form->status == 400);
    const std::string many(1 << 16, ' ');
    const auto isCutOff = [&](const std::string& start, const std::string& more) {
        const Socket socket(f.port);
        bool goesOn = socket.send(start);
        int sent = 0;
        while (goesOn && sent < 4096) { // 256 MiB
            goesOn = socket.send(more);
            ++sent;
        }
        return sent < 4096;
    };
    CHECK(isCutOff(head + "Content-Length: 1000000000000\r\n\r\n", many));
    CHECK(isCutOff(head + "Transfer-Encoding: chunked\r\n\r\n", "10000\r\n" + many + "\r\n"));
    CHECK(isCutOff(head + "X: ", many));                      // a header without end
    CHECK(isCutOff("GET /", many));                           // a path without end
    CHECK(isCutOff(head, "A: 1\r\nB: 2\r\nC: 3\r\n" + many)); // headers without end
    CHECK(f.get(f.path("/stats")) == 200);
    CHECK(f.wishes().number == 0);
    CHECK(peakMemoryKb() - before < 64 << 10);
    f.show();
    for (const char* header : {"Range: bytes=0-", "RANGE:bytes=0-1,0-1"}) { // they would take much stack and memory
        const Socket socket(f.port);
        REQUIRE(socket.send("GET " + f.path("/picture.png") + " HTTP/1.1\r\n" + header + "\r\n\r\n"));
        CHECK(socket.receiveAll().rfind("HTTP/1.1 400", 0) == 0);
    }
}

TEST_CASE("connections that wait take no files of the job")
{
    const auto openFiles = [] {
        const std::filesystem::directory_iterator files("/proc/self/fd");
        return std::distance(begin(files), end(files));
    };
    Fixture f;
    const auto before = openFiles();
    std::vector<std::unique_ptr<Socket>> viewers;
    const auto come = [&] {
        viewers.push_back(std::make_unique<Socket>(f.port));
        REQUIRE(viewers.back()->isOpen());
        REQUIRE(viewers.back()->send("GET " + f.path("/frame") + " HTTP/1.1\r\nConnection: close\r\n\r\n")); // none yet
    };
    for (int served = 1; served <= 48; ++served) {
        come();
        while (openFiles() - before < 2 * served)
            std::this_thread::yield();
    }
    for (int i = 0; i < 4; ++i)
        come();
    auto most = before;
    for (const auto until = Clock::now() + milliseconds(200); Clock::now() < until;)
        most = std::max(most, openFiles());
    CHECK(most - before <= 2 * 48 + 4 + 1); // both ends of those; theirs of the others; one that is accepted next
    f.show();
    for (const auto& viewer : viewers) {
        pollfd answer{viewer->fd(), POLLIN, 0};
        CHECK(::poll(&answer, 1, 20000) == 1);
    }
}

TEST_CASE("ten thousand random requests")
{
    const auto seed = std::random_device{}();
    std::printf("seed of the random requests: %u\n", seed);
    INFO("seed " << seed);
    Fixture f;
    f.show();
    std::mt19937 random(seed);
    const auto one = [&](std::size_t count) {
        return std::uniform_int_distribution<std::size_t>(0, count - 1)(random);
    };
    const auto pick = [&](const std::vector<std::string>& words) { return words[one(words.size())]; };
    const auto noise = [&](std::size_t most) {
        std::string bytes(one(most + 1), ' ');
        for (char& byte : bytes)
            byte = static_cast<char>(one(256));
        return bytes;
    };
    int answered = 0;
    for (int i = 0; i < 10000; ++i) {
        std::string body;
        if (one(2))
            body = '{'
                   + pick({R"("azimuth")", R"("elevation")", R"("distance")", R"("target")", R"("width")",
                           R"("samples")", R"("command")"})
                   + ':' + pick({"1", "-1e308", "1e-308", "[1,2,3]", "[[[[", "\"go\"", "\"step\"", "null", "16", "{}"})
                   + '}';
        else
            body = noise(300);
        std::string request =
            pick({"GET", "POST", "HEAD", "PUT", "DELETE", "OPTIONS", "PRI", ""}) + ' '
            + (one(8) ? pick({"/", "/frame", "/picture.png", "/stats", "/camera", "/command", "//", "/%00", "*"})
                      : noise(40))
            + '?' + (one(4) ? "token=" + f.token + '&' : noise(20))
            + pick({"", "after=0", "after=00", "after=-1", "quality=50", "quality=%zz", "after=0&after=1", "%&=&="})
            + ' ' + pick({"HTTP/1.1", "HTTP/1.0", "HTTP/9", ""}) + "\r\n";
        if (one(2))
            request += pick({"Range: bytes=0-1", "Range: bytes=5-", "Range: bytes=-9999999999,3-1",
                             "Expect: 100-continue", "Content-Encoding: gzip",
                             "Content-Type: multipart/form-data; boundary=", "Accept-Encoding: br, gzip",
                             "Connection: keep-alive", "Host: ", ": ", "Transfer-Encoding: chunked"})
                       + "\r\n";
        request +=
            "Content-Length: " + pick({std::to_string(body.size()), "0", "-1", "99999999999999999999", "x"}) + "\r\n";
        request += "Connection: close\r\n\r\n" + body;
        if (!one(4)) { // some bytes are others
            for (std::size_t n = one(4) + 1; n > 0; --n)
                request[one(request.size())] = static_cast<char>(one(256));
            request.resize(one(request.size() + 1));
        }
        const Socket socket(f.port);
        REQUIRE(socket.isOpen());
        socket.send(request);
        if (one(8)) { // others hang up without waiting for an answer
            ::shutdown(socket.fd(), SHUT_WR);
            answered += !socket.receiveAll().empty();
        }
    }
    INFO("answered " << answered);
    CHECK(answered > 5000);
    CHECK(f.wishes().ends == 0);
    CHECK(f.get(f.path("/stats")) == 200);
    CHECK(f.post("/camera", R"({"azimuth": 77})") == 200);
    CHECK(f.wishes().camera.azimuth == 77);
}

TEST_CASE("viewers that are dead or slow take nothing from the job and the other viewers")
{
    Fixture f;
    f.show(2048, 2048);
    std::vector<std::unique_ptr<Socket>> dead;
    for (int i = 0; i < 12; ++i) { // connect and say nothing; ask and never read; begin to ask
        dead.push_back(std::make_unique<Socket>(f.port));
        REQUIRE(dead.back()->isOpen());
        if (i % 3 == 1)
            REQUIRE(dead.back()->send("GET " + f.path("/frame", "&quality=100") + " HTTP/1.1\r\n\r\n"));
        if (i % 3 == 2)
            REQUIRE(dead.back()->send("GET /fra"));
    }
    struct Slowest {
        Clock::duration picture{}, answer{};
    };
    int shown = 1;
    const auto showAll = [&] {
        Slowest times;
        for (int i = 0; i < 50; ++i) {
            const auto begin = Clock::now();
            f.show(320, 200, i);
            times.picture = std::max(times.picture, Clock::now() - begin);
            CHECK(f.get(f.path("/frame", "&after=" + std::to_string(shown++))) == 200);
            times.answer = std::max(times.answer, Clock::now() - begin);
        }
        return times;
    };
    constexpr milliseconds pictureLimit(500), answerLimit(1500); // the job copies 250 kB
    const auto isSlow = [&](bool, const auto& times) {           // on a busy machine, but not each time
        return times.get().picture >= pictureLimit || times.get().answer >= answerLimit;
    };
    const Slowest slowest = undisturbed(showAll, isSlow);
    CHECK(slowest.picture < pictureLimit);
    CHECK(slowest.answer < answerLimit);
    // Nor does the job keep them: of the picture that nobody reads only what the system has room for is sent.
    for (std::size_t i = 1; i < dead.size(); i += 3) {
        pollfd picture{dead[i]->fd(), POLLIN, 0};
        REQUIRE(::poll(&picture, 1, 60000) == 1);
    }
    const auto begun = Clock::now(); // on a busy machine long after they have asked
    for (std::size_t i = 0; i < dead.size(); ++i) {
        if (i % 3 == 1) {
            std::this_thread::sleep_until(begun + seconds(10)); // it is this time that it must not wait for
            CHECK(dead[i]->receiveAll().size() < std::size_t{8} << 20);
        } else {
            pollfd end{dead[i]->fd(), POLLRDHUP, 0};
            CHECK(::poll(&end, 1, 15000) == 1);
        }
    }
}

TEST_CASE("several viewers see the same pictures")
{
    Fixture f;
    std::atomic<int> ready{0};
    std::vector<std::vector<std::uint64_t>> seen(4);
    std::vector<std::thread> viewers;
    for (std::vector<std::uint64_t>& mine : seen)
        viewers.emplace_back([&] {
            httplib::Client to = f.client();
            to.set_keep_alive(true);
            std::uint64_t last = 0;
            ++ready;
            while (last < 100) {
                const auto answer = to.Get(f.path("/frame", "&after=" + std::to_string(last)));
                if (!answer || answer->status != 200)
                    return;
                const std::uint64_t number = std::stoull(answer->get_header_value("X-Frame"));
                if (number <= last)
                    return;
                last = number;
                mine.push_back(number);
            }
        });
    while (ready < 4)
        std::this_thread::yield();
    for (int i = 0; i < 100; ++i) {
        f.show();
        std::this_thread::yield();
    }
    for (std::thread& viewer : viewers)
        viewer.join();
    for (const std::vector<std::uint64_t>& mine : seen) {
        REQUIRE(!mine.empty());
        CHECK(mine.back() == 100); // the last is not missed, however many are left out
    }
}

// By itself, as it measures how long the end of a job takes: see live.cmake.
TEST_CASE("the end of a job is told to its viewers, and waits for none that is dead", "[.][end]")
{
    int port = 0, status = 0;
    bool isSent = false;
    const auto took = undisturbed(
        [&] {
            auto f = std::make_unique<Fixture>();
            f->show(2048, 2048);
            port = f->port;
            const std::string path = f->path("/frame", "&after=1");
            std::thread viewer([&] {
                httplib::Client to("127.0.0.1", port);
                to.set_read_timeout(20);
                to.set_keep_alive(true);
                const auto answer = to.Get(path),
                           again = to.Get(path); // one that was between two requests is told, too
                status = answer && again && answer->status == again->status ? answer->status : -1;
            });
            while (json::parse(f->client().Get(f->path("/stats"))->body)["waiting"] != 1)
                std::this_thread::yield();
            // What `deaf` asks for is encoded already, as the end waits for an encoder.
            const std::string large = f->path("/frame", "&quality=100");
            f->client().Get(large);
            const Socket silent(port), deaf(port);
            isSent = deaf.send("GET " + large + " HTTP/1.1\r\n\r\n");
            const auto begin = Clock::now();
            f.reset();
            const auto time = Clock::now() - begin;
            viewer.join();
            return time;
        },
        [&](bool stoodStill, const auto& its) { // the viewer has 0.4 s for its second request
            return takesLong(stoodStill, its) || status != 410;
        });
    CHECK(isSent);
    CHECK(took < seconds(4));
    CHECK(status == 410);
    CHECK_FALSE(Socket(port).isOpen());
}

} // namespace live_server
