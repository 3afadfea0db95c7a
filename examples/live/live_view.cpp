#include "live_view.hpp"

#include "bounded_server.hpp"
#include "interrupt.hpp"

#include <nlohmann/json.hpp>
#include <png.h>
#include <turbojpeg.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <deque>
#include <map>
#include <mutex>
#include <optional>
#include <random>
#include <stdexcept>
#include <thread>
#include <utility>

namespace example {

extern const char viewPage[]; // view.html

namespace {

using Json = nlohmann::ordered_json;

// 128 random bits.
std::string randomToken()
{
    std::random_device random;
    std::string token;
    for (int word = 0; word < 4; ++word) {
        char digits[9];
        std::snprintf(digits, sizeof digits, "%08x", static_cast<unsigned>(random()));
        token += digits;
    }
    return token;
}

// Compares in a time that does not depend on where they differ.
bool isSame(const std::string& a, const std::string& b)
{
    unsigned differs = a.size() != b.size();
    for (std::size_t i = 0; i < std::min(a.size(), b.size()); ++i)
        differs |= static_cast<unsigned char>(a[i] ^ b[i]);
    return differs == 0;
}

std::string jpegOf(const std::uint8_t* rgba, int width, int height, int quality)
{
    const std::unique_ptr<void, int (*)(void*)> encoder(tjInitCompress(), tjDestroy);
    unsigned char* bytes = nullptr;
    unsigned long size = 0;
    if (!encoder
        || tjCompress2(encoder.get(), rgba, width, 4 * width, height, TJPF_RGBX, &bytes, &size,
                       quality >= 90 ? TJSAMP_444 : TJSAMP_420, quality, 0)
               != 0)
        throw std::runtime_error("no JPEG could be made");
    std::string jpeg(reinterpret_cast<const char*>(bytes), size);
    tjFree(bytes);
    return jpeg;
}

std::string pngOf(const std::uint8_t* rgba, int width, int height)
{
    const std::size_t pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    std::vector<std::uint8_t> rgb(3 * pixels);
    for (std::size_t i = 0; i < pixels; ++i)
        std::memcpy(rgb.data() + 3 * i, rgba + 4 * i, 3);
    png_image image{};
    image.version = PNG_IMAGE_VERSION;
    image.width = static_cast<png_uint_32>(width);
    image.height = static_cast<png_uint_32>(height);
    image.format = PNG_FORMAT_RGB;
    std::string png(PNG_IMAGE_PNG_SIZE_MAX(image), '\0');
    png_alloc_size_t size = png.size();
    if (png_image_write_to_memory(&image, png.data(), &size, 0, rgb.data(), 0, nullptr) == 0)
        throw std::runtime_error("no PNG could be made");
    png.resize(size);
    return png;
}

// A picture that is shown, and its JPEG encodings, which all viewers share.
class Shown {
public:
    Shown(std::uint64_t itsNumber, const std::uint8_t* rgba, int itsWidth, int itsHeight,
          const dfb::FrameReport& itsReport, LivePicture itsPicture)
        : number(itsNumber), width(itsWidth), height(itsHeight), report(itsReport), about(std::move(itsPicture)),
          rgba_(rgba, rgba + 4 * static_cast<std::size_t>(itsWidth) * static_cast<std::size_t>(itsHeight))
    {
    }

    std::string jpeg(int quality) const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        std::string& jpeg = jpegs_[quality];
        if (jpeg.empty())
            jpeg = jpegOf(rgba_.data(), width, height, quality);
        return jpeg;
    }
    std::string png() const { return pngOf(rgba_.data(), width, height); }

    const std::uint64_t number;
    const int width, height;
    const dfb::FrameReport report;
    const LivePicture about;

private:
    std::vector<std::uint8_t> rgba_;
    mutable std::mutex mutex_;
    mutable std::map<int, std::string> jpegs_; // by quality
};

struct Refused : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// Sets `to` to the number of that name, if there is one.
template <class Number>
void takeNumber(const Json& json, const char* name, double least, double most, Number& to)
{
    const auto found = json.find(name);
    if (found == json.end())
        return;
    if (!found->is_number())
        throw Refused(std::string(name) + " is no number");
    const double value = found->get<double>();
    if (!(value >= least && value <= most))
        throw Refused(std::string(name) + " is out of range");
    to = static_cast<Number>(value);
}

std::uint64_t wholeNumber(const httplib::Request& request, const char* name, std::uint64_t otherwise)
{
    if (!request.has_param(name))
        return otherwise;
    const std::string text = request.get_param_value(name);
    if (text.empty() || text.size() > 18 || text.find_first_not_of("0123456789") != std::string::npos)
        throw Refused(std::string(name) + " is no whole number");
    return std::stoull(text);
}

class Server final : public LiveView {
public:
    Server(const std::string& title, int port, bool hasSteps) : title_(title), hasSteps_(hasSteps)
    {
        addHandlers();
        const char* here = "127.0.0.1";
        int bound = port;
        if (port < 0)
            bound = http_.bind_to_port(here, defaultPort) ? defaultPort : http_.bind_to_any_port(here);
        else if (port == 0)
            bound = http_.bind_to_any_port(here);
        else if (!http_.bind_to_port(here, port))
            bound = -1;
        if (bound <= 0)
            throw std::runtime_error("--live: port " + std::to_string(std::max(0, port))
                                     + " of 127.0.0.1 cannot be had: is something else listening there?");
        port_ = std::to_string(bound);
        url_ = std::string("http://") + here + ':' + port_ + "/?token=" + token_;
        listener_ = std::thread([this] {
            http_.listen_after_bind();
            hasListened_ = true;
        });
        while (!http_.is_running() && !hasListened_) // stop() is lost on a server that is about to listen
            std::this_thread::yield();
    }

    ~Server() override
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            isOver_ = true;
            changed_.notify_all();
        }
        http_.hangUp(std::chrono::milliseconds(400), std::chrono::seconds(2));
        http_.stop();
        listener_.join();
    }

    const std::string& url() const override { return url_; }

    std::string invitation() const override
    {
        char host[256] = "";
        if (gethostname(host, sizeof host - 1) != 0)
            std::snprintf(host, sizeof host, "HOST");
        return "look at it in a browser on this machine: " + url_ + "\nfrom another machine, first run there: ssh -L "
               + port_ + ":127.0.0.1:" + port_ + ' ' + host + '\n';
    }

    void open(const LiveScene& scene, const LiveWishes& home) override
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        scene_ = scene;
        wishes_ = home;
        look_ = home.look;
        home_ = home.camera;
    }

    LiveWishes waitForChange(std::uint64_t number, std::chrono::milliseconds atMost) const override
    {
        const auto until = std::chrono::steady_clock::now() + std::min<std::chrono::milliseconds>(atMost, longest);
        std::unique_lock<std::mutex> lock(mutex_);
        for (;;) {
            LiveWishes now = wishes_;
            now.ends = ends_ || Interrupt::happened();
            if (now.number != number || now.ends || std::chrono::steady_clock::now() >= until)
                return now;
            // A signal does not wake this thread, so it looks every 100 ms.
            changed_.wait_until(lock,
                                std::min(until, std::chrono::steady_clock::now() + std::chrono::milliseconds(100)));
        }
    }

    bool hasMoved(std::uint64_t look, bool onlyIfSmaller) const override
    {
        return ends_ || Interrupt::happened() || (onlyIfSmaller ? smaller_ > look : look_ != look);
    }

    void whileWatching(std::uint64_t look, bool onlyIfSmaller, const std::function<void()>& onMove,
                       const std::function<void()>& work) override
    {
        struct Watch {
            Server& server;
            ~Watch()
            {
                const std::lock_guard<std::mutex> lock(server.watchMutex_);
                server.onMove_ = nullptr;
            }
        };
        const Watch watch{*this};
        {
            const std::lock_guard<std::mutex> lock(watchMutex_);
            watched_ = look;
            isOnlyIfSmaller_ = onlyIfSmaller;
            onMove_ = onMove;
            callIfMoved();
        }
        work();
    }

    void show(const std::uint8_t* rgba, int width, int height, const dfb::FrameReport& report,
              LivePicture picture) override
    {
        const std::uint64_t number = shown_ ? shown_->number + 1 : 1; // only this thread changes it
        auto next = std::make_shared<const Shown>(number, rgba, width, height, report, std::move(picture));
        const std::lock_guard<std::mutex> lock(mutex_);
        shown_ = std::move(next);
        times_.push_back({number, report.totalMs, report.renderMsMax});
        if (times_.size() > 120)
            times_.pop_front();
        changed_.notify_all();
    }

private:
    struct Time {
        std::uint64_t number;
        double totalMs, renderMs;
    };
    using Request = httplib::Request;
    using Response = httplib::Response;

    static constexpr std::chrono::hours longest{24 * 365};
    static constexpr std::chrono::seconds mostWait{8}; // for a picture
    static constexpr std::size_t mostBody = 4096;

    // Needs the lock of watchMutex_.
    void callIfMoved()
    {
        if (onMove_ && hasMoved(watched_, isOnlyIfSmaller_))
            std::exchange(onMove_, nullptr)();
    }

    void addHandlers()
    {
        http_.set_payload_max_length(mostBody);
        http_.set_default_headers({{"Cache-Control", "no-store"},
                                   {"Referrer-Policy", "no-referrer"},
                                   {"X-Content-Type-Options", "nosniff"},
                                   {"X-Frame-Options", "DENY"}});
        http_.set_pre_routing_handler([this](const Request& request, Response& response) {
            if (isSame(request.get_param_value("token"), token_))
                return httplib::Server::HandlerResponse::Unhandled;
            response.status = 403;
            BoundedServer::endAfter(response);
            response.set_content("The token is wrong: use the address that the job has printed.\n", "text/plain");
            return httplib::Server::HandlerResponse::Handled;
        });
        const auto get = [this](const char* path, void (Server::*answer)(const Request&, Response&)) {
            http_.Get(path, [this, answer](const Request& request, Response& response) {
                guarded(response, [&] { (this->*answer)(request, response); });
            });
        };
        get("/", &Server::page);
        get("/frame", &Server::frame);
        get("/picture.png", &Server::picture);
        get("/stats", &Server::stats);
        const auto post = [this](const char* path, void (Server::*answer)(const Json&, Response&)) {
            http_.Post(path, [=](const Request& request, Response& response, const httplib::ContentReader& read) {
                guarded(response, [&] { take(request, response, read, answer); });
            });
        };
        post("/camera", &Server::camera);
        post("/command", &Server::command);
    }

    // Reads the body piece by piece, because the library limits only bodies that say how long they are.
    void take(const Request& request, Response& response, const httplib::ContentReader& read,
              void (Server::*answer)(const Json&, Response&))
    {
        std::string body;
        bool isTooLong = false;
        const auto add = [&](const char* data, std::size_t size) {
            isTooLong = body.size() + size > mostBody;
            if (!isTooLong)
                body.append(data, size);
            return !isTooLong;
        };
        if (request.is_multipart_form_data()) // for which the library has another reader
            throw Refused("the body is no JSON object");
        if (!read(add)) {
            if (isTooLong || response.status < 400)
                response.status = 413;
            return BoundedServer::endAfter(response);
        }
        const Json json = Json::parse(body, nullptr, false);
        if (!json.is_object())
            throw Refused("the body is no JSON object");
        (this->*answer)(json, response);
    }

    template <class Answer>
    static void guarded(Response& response, const Answer& answer)
    {
        try {
            answer();
        } catch (const std::exception& why) {
            response.status = dynamic_cast<const Refused*>(&why) ? 400 : 500;
            response.set_content(std::string(why.what()) + '\n', "text/plain");
        }
    }

    void page(const Request&, Response& response)
    {
        response.set_header("Content-Security-Policy",
                            "default-src 'none'; script-src 'unsafe-inline'; style-src "
                            "'unsafe-inline'; connect-src 'self'; img-src 'self' blob: data:");
        response.set_content(viewPage, "text/html; charset=utf-8");
    }

    void frame(const Request& request, Response& response)
    {
        const std::uint64_t after = wholeNumber(request, "after", 0), quality = wholeNumber(request, "quality", 85);
        if (quality < 10 || quality > 100)
            throw Refused("quality is out of range");
        std::shared_ptr<const Shown> shown;
        {
            std::unique_lock<std::mutex> lock(mutex_);
            ++waiting_;
            changed_.wait_for(lock, mostWait, [&] { return isOver_ || (shown_ && shown_->number > after); });
            --waiting_;
            shown = shown_;
            if (!shown || shown->number <= after) {
                response.status = isOver_ ? 410 : 204;
                BoundedServer::endAfter(response);
                return;
            }
        }
        describe(*shown, response);
        response.set_content(shown->jpeg(static_cast<int>(quality / 5 * 5)), "image/jpeg");
    }

    void picture(const Request&, Response& response)
    {
        const std::shared_ptr<const Shown> shown = newest();
        if (!shown) {
            response.status = 404;
            return;
        }
        describe(*shown, response);
        response.set_content(shown->png(), "image/png");
    }

    static void describe(const Shown& shown, Response& response)
    {
        response.set_header("X-Frame", std::to_string(shown.number));
        response.set_header("X-Wishes", std::to_string(shown.about.wishes.number));
        response.set_header("X-Samples", std::to_string(shown.about.samples));
    }

    std::shared_ptr<const Shown> newest() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return shown_;
    }

    void stats(const Request&, Response& response)
    {
        Json json;
        std::shared_ptr<const Shown> shown;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            shown = shown_;
            json["title"] = title_;
            json["has_steps"] = hasSteps_;
            json["waiting"] = waiting_;
            json["wishes"] = {{"number", wishes_.number},
                              {"paused", wishes_.isPaused != 0},
                              {"samples", wishes_.samples},
                              {"camera", toJson(wishes_.camera)}};
            json["scene"] = nullptr;
            if (scene_)
                json["scene"] = {{"axes", scene_->axes},
                                 {"unit", scene_->unit},
                                 {"field_of_view", scene_->fieldOfView},
                                 {"most_samples", scene_->mostSamples},
                                 {"most_side", scene_->mostSide},
                                 {"ranks", scene_->ranks},
                                 {"home", toJson(home_)}};
            json["times"] = Json::array();
            for (const Time& time : times_)
                json["times"].push_back({time.number, time.totalMs, time.renderMs});
        }
        json["frame"] = nullptr;
        if (shown)
            json["frame"] = toJson(*shown);
        response.set_content(json.dump(-1, ' ', false, Json::error_handler_t::replace), "application/json");
    }

    static Json toJson(const LiveCamera& camera)
    {
        return {{"azimuth", camera.azimuth},
                {"elevation", camera.elevation},
                {"distance", camera.distance},
                {"target", camera.target}};
    }

    static Json toJson(const Shown& shown)
    {
        const dfb::FrameReport& report = shown.report;
        Json json;
        json["number"] = shown.number;
        json["wishes"] = shown.about.wishes.number;
        json["width"] = shown.width;
        json["height"] = shown.height;
        json["samples"] = shown.about.samples;
        json["camera"] = toJson(shown.about.wishes.camera);
        json["distance"] = shown.about.distance;
        json["command_line"] = shown.about.camera;
        json["step"] = shown.about.step;
        json["total_ms"] = report.totalMs;
        json["render_ms"] = report.renderMsMax;
        json["compositing_ms"] = report.compositingOverheadMs;
        json["bytes_sent"] = report.bytesSent;
        json["messages_sent"] = report.messagesSent;
        json["tiles_touched"] = report.tilesTouched;
        json["tiles_total"] = report.tilesTotal;
        json["peak_memory_bytes"] = report.peakMemoryBytes;
        json["tile_size"] = shown.about.tileSize;
        json["owners"] = shown.about.owners;
        return json;
    }

    void camera(const Json& json, Response& response)
    {
        change(response, [&](LiveWishes& wishes) {
            if (!scene_)
                throw Refused("the job has not begun yet");
            LiveCamera& camera = wishes.camera;
            takeNumber(json, "azimuth", -36000, 36000, camera.azimuth);
            takeNumber(json, "elevation", -90, 90, camera.elevation);
            takeNumber(json, "distance", 0, 1000, camera.distance);
            if (camera.distance > 0)
                camera.distance = std::max(camera.distance, 1e-4);
            takeNumber(json, "width", 16, scene_->mostSide, wishes.width);
            takeNumber(json, "height", 16, scene_->mostSide, wishes.height);
            takeNumber(json, "samples", 1, scene_->mostSamples, wishes.samples);
            if (const auto target = json.find("target"); target != json.end()) {
                if (!target->is_array() || target->size() != 3)
                    throw Refused("target is no list of three numbers");
                for (std::size_t i = 0; i < 3; ++i) {
                    const Json one{{"target", (*target)[i]}};
                    const double middle = home_.target[i], most = 1000 * scene_->unit;
                    takeNumber(one, "target", middle - most, middle + most, camera.target[i]);
                }
            }
        });
    }

    void command(const Json& json, Response& response)
    {
        const auto found = json.find("command");
        const std::string word = found != json.end() && found->is_string() ? found->get<std::string>() : "";
        if (word == "end") {
            ends_ = true;
            change(response, [](LiveWishes&) {});
        } else if (hasSteps_ && (word == "pause" || word == "go")) {
            change(response, [&](LiveWishes& wishes) { wishes.isPaused = word == "pause"; });
        } else if (hasSteps_ && word == "step") {
            change(response, [&](LiveWishes& wishes) {
                wishes.isPaused = 1;
                ++wishes.steps;
            });
        } else {
            throw Refused("there is no such command");
        }
    }

    // Lets `edit` change the wishes; nothing changes if it throws. Answers with their number.
    template <class Edit>
    void change(Response& response, const Edit& edit)
    {
        std::uint64_t number = 0;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            LiveWishes next = wishes_;
            edit(next);
            const LiveCamera &a = wishes_.camera, &b = next.camera;
            const bool looksElsewhere = a.azimuth != b.azimuth || a.elevation != b.elevation || a.distance != b.distance
                                        || a.target != b.target || wishes_.width != next.width
                                        || wishes_.height != next.height;
            const bool isSmaller =
                std::int64_t{next.width} * next.height < std::int64_t{wishes_.width} * wishes_.height;
            if (looksElsewhere || wishes_.samples != next.samples || wishes_.isPaused != next.isPaused
                || wishes_.steps != next.steps)
                ++next.number;
            if (looksElsewhere)
                next.look = next.number;
            wishes_ = next;
            look_ = next.look;
            if (isSmaller)
                smaller_ = next.look;
            number = next.number;
            changed_.notify_all();
        }
        {
            const std::lock_guard<std::mutex> lock(watchMutex_);
            callIfMoved();
        }
        response.set_content(Json{{"wishes", number}}.dump(), "application/json");
    }

    const std::string title_, token_ = randomToken();
    const bool hasSteps_;
    std::string port_, url_;

    mutable std::mutex mutex_; // guards what follows
    mutable std::condition_variable changed_;
    std::optional<LiveScene> scene_; // none before open()
    LiveWishes wishes_;
    LiveCamera home_;
    std::shared_ptr<const Shown> shown_;
    std::deque<Time> times_;
    int waiting_ = 0; // requests for pictures
    bool isOver_ = false;

    std::atomic<std::uint64_t> look_{0}, smaller_{0}; // numbers of the last changes of the look, and to a smaller size
    std::atomic<bool> ends_{false};

    std::mutex watchMutex_; // guards these three; taken after mutex_
    std::uint64_t watched_ = 0;
    bool isOnlyIfSmaller_ = false;
    std::function<void()> onMove_;

    BoundedServer http_;
    std::atomic<bool> hasListened_{false};
    std::thread listener_;
};

} // namespace

std::unique_ptr<LiveView> LiveView::listen(const std::string& title, int port, bool hasSteps)
{
    return std::make_unique<Server>(title, port, hasSteps);
}

} // namespace example
