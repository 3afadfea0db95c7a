// Runs a job with a live view, as its user starts and ends it: job CASE COMMAND...
//   button     the button on the page ends the job
//   interrupt  Ctrl-C ends the job, as the launcher passes it on
//   killed     the same, with a launcher that returns 1 and soon kills the ranks: that of Open MPI
//   rest       while the camera rests, the ranks use no processor time
//   fire       every camera that a viewer may ask for is rendered
//   step       a simulation is paused, advanced by a step, and resumed
//   taken      a second job on the same port ends with 1
// COMMAND starts the job with --live 0. The job must end with 0, or 1 if killed, within a time limit.
#include <httplib.h>
#include <nlohmann/json.hpp>

#include <fcntl.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace {

using nlohmann::json;
using Clock = std::chrono::steady_clock;

[[noreturn]] void fail(const std::string& why) { throw std::runtime_error(why); }

// The job and a viewer of it.
class Job {
public:
    explicit Job(char** command)
    {
        int ends[2];
        if (pipe(ends) != 0)
            fail("no pipe");
        pid_ = fork();
        if (pid_ == 0) {
            setpgid(0, 0);
            prctl(PR_SET_PDEATHSIG, SIGTERM); // otherwise the job would outlive a test that is killed
            dup2(ends[1], STDOUT_FILENO);
            dup2(open("/dev/null", O_RDONLY), STDIN_FILENO);
            close(ends[0]);
            close(ends[1]);
            execvp(command[0], command);
            _exit(127);
        }
        close(ends[1]);
        FILE* output = fdopen(ends[0], "r");
        std::string said;
        char line[512];
        while (url_.empty() && std::fgets(line, sizeof line, output)) {
            said += line;
            const std::string text = line;
            const std::size_t begin = text.find("http://127.0.0.1:");
            if (begin != std::string::npos)
                url_ = text.substr(begin, text.find_first_of(" \n", begin) - begin);
        }
        if (url_.empty())
            fail("it has printed no address: " + said);
        port_ = std::atoi(url_.c_str() + url_.rfind(':') + 1);
        token_ = url_.substr(url_.find("token=") + 6);
        reader_ = std::thread([output] { // the job may go on printing
            char more[512];
            while (std::fgets(more, sizeof more, output))
                std::fputs(more, stdout);
            std::fclose(output);
        });
    }
    ~Job()
    {
        if (pid_ > 0) {
            kill(-pid_, SIGTERM);
            waitpid(pid_, nullptr, 0);
        }
        reader_.join();
    }

    json stats() const
    {
        const auto answer = client().Get(path("/stats"));
        if (!answer || answer->status != 200)
            fail("no statistics");
        return json::parse(answer->body);
    }
    // Returns the number of the viewer's wishes after the post.
    std::uint64_t post(const std::string& name, const json& body) const
    {
        const auto answer = client().Post(path(name), body.dump(), "application/json");
        if (!answer || answer->status != 200)
            fail(name + " was refused: " + body.dump());
        return json::parse(answer->body)["wishes"].get<std::uint64_t>();
    }
    // Waits for a picture with these wishes, with all samples if `isRefined`. Returns its statistics.
    json see(std::uint64_t wishes, bool isRefined) const
    {
        std::string last = "0";
        for (;;) {
            const auto answer = client().Get(path("/frame") + "&after=" + last);
            if (!answer || (answer->status != 200 && answer->status != 204))
                fail("no picture comes");
            if (answer->status == 204)
                continue;
            last = answer->get_header_value("X-Frame");
            if (std::stoull(answer->get_header_value("X-Wishes")) < wishes)
                continue;
            const json now = stats();
            if (!isRefined || now["frame"]["samples"] >= now["wishes"]["samples"])
                return now;
        }
    }

    int port() const { return port_; }
    void interrupt() const { kill(-pid_, SIGINT); } // as a terminal does: to all processes in the foreground

    // Waits until the job has ended.
    void expectEnd(int code)
    {
        int status = 0;
        const auto begin = Clock::now();
        if (waitpid(pid_, &status, 0) != pid_)
            fail("no status");
        pid_ = 0;
        std::printf("ended after %.2f s\n", std::chrono::duration<double>(Clock::now() - begin).count());
        if (!WIFEXITED(status) || WEXITSTATUS(status) != code)
            fail("it has ended with " + std::to_string(WIFEXITED(status) ? WEXITSTATUS(status) : -WTERMSIG(status)));
    }

    // Seconds of processor time so far, for each process of the job.
    std::vector<double> processorTimes() const
    {
        std::vector<double> times;
        for (const auto& entry : std::filesystem::directory_iterator("/proc")) {
            std::ifstream file(entry.path() / "stat");
            std::stringstream text;
            text << file.rdbuf();
            const std::string all = text.str();
            const std::size_t name = all.find('('), end = all.rfind(')');
            if (name == std::string::npos || end == std::string::npos
                || all.substr(name + 1, end - name - 1) != "dfb_render")
                continue;
            std::istringstream rest(all.substr(end + 2));
            std::vector<std::string> fields;
            for (std::string field; rest >> field;)
                fields.push_back(field);
            if (isMine(std::stoi(fields[1])))
                times.push_back((std::stod(fields[11]) + std::stod(fields[12]))
                                / static_cast<double>(sysconf(_SC_CLK_TCK)));
        }
        return times;
    }

private:
    httplib::Client client() const
    {
        httplib::Client to("127.0.0.1", port_);
        to.set_read_timeout(30);
        return to;
    }
    std::string path(const std::string& name) const { return name + "?token=" + token_; }

    // Whether that process is the job or descends from it.
    bool isMine(int pid) const
    {
        while (pid > 1 && pid != pid_) {
            std::ifstream file("/proc/" + std::to_string(pid) + "/stat");
            std::string all;
            std::getline(file, all);
            const std::size_t end = all.rfind(')');
            if (end == std::string::npos)
                return false;
            std::istringstream rest(all.substr(end + 2));
            std::string state;
            rest >> state >> pid;
        }
        return pid == pid_;
    }

    pid_t pid_ = 0;
    std::string url_, token_;
    int port_ = 0;
    std::thread reader_;
};

void rest(const Job& job)
{
    job.see(0, true);
    const std::vector<double> before = job.processorTimes();
    const auto begin = Clock::now();
    std::this_thread::sleep_for(std::chrono::seconds(3)); // the time over which it is measured
    const std::vector<double> after = job.processorTimes();
    const double passed = std::chrono::duration<double>(Clock::now() - begin).count();
    if (before.empty() || before.size() != after.size())
        fail("its processes were not found");
    double most = 0;
    for (std::size_t i = 0; i < after.size(); ++i)
        most = std::max(most, (after[i] - before[i]) / passed);
    std::printf("%zu processes at rest, the busiest takes %.1f %% of a core\n", after.size(), 100 * most);
    if (most > 0.1)
        fail("its ranks do not rest");
    job.see(job.post("/camera", {{"azimuth", 123}}), false);
}

void fire(const Job& job)
{
    const auto seed = std::random_device{}();
    std::printf("seed of the cameras: %u\n", seed);
    std::fflush(stdout); // in case the test is killed
    std::mt19937 random(seed);
    const auto pick = [&](const std::vector<double>& values) {
        return values[std::uniform_int_distribution<std::size_t>(0, values.size() - 1)(random)];
    };
    const json target = job.stats()["scene"]["home"]["target"];
    std::uint64_t last = 0;
    for (int i = 0; i < 200; ++i) {
        json wish;
        wish["azimuth"] = pick({0, 90, -36000, 36000, 1e-300, 0.1});
        wish["elevation"] = pick({0, 90, -90, 89.99, 45});
        wish["distance"] = pick({0, 1e-300, 1e-4, 0.5, 1, 2, 1000});
        wish["target"] = {target[0].get<double>() + pick({0, 0.5, 500, -500}), target[1],
                          target[2].get<double>() + pick({0, 1e-9})};
        wish["width"] = i % 2 ? pick({16, 64}) : pick({17, 255}); // of the same view there is no other picture
        wish["height"] = pick({16, 100, 300});
        wish["samples"] = pick({1, 2, 4});
        last = job.post("/camera", wish);
        job.see(last, i % 8 == 0);
    }
    job.see(last, true);
    job.post("/camera", {{"distance", 2}, {"width", 64}, {"height", 48}, {"target", target}});
}

// For a job with a picture every 20 steps.
void step(const Job& job)
{
    job.post("/command", {{"command", "pause"}});
    // Every answer to a wish is a picture of the step at which the job is paused.
    const auto pausedAt = [&](double azimuth) {
        return job.see(job.post("/camera", {{"azimuth", azimuth}}), false)["frame"]["step"].get<int>();
    };
    int at = 0;
    for (int i = 1; i < 1000 && !(at > 0 && pausedAt(i) == at); i += 2) // it runs on to its next picture
        at = pausedAt(i + 1);
    for (int i = 0; i < 5; ++i)
        if (at % 20 != 0 || pausedAt(-i) != at)
            fail("it goes on while it is paused, at step " + std::to_string(at));
    const json next = job.see(job.post("/command", {{"command", "step"}}), false);
    if (next["frame"]["step"] != at + 20 || pausedAt(4) != at + 20)
        fail("a step of " + std::to_string(next["frame"]["step"].get<int>() - at));
    const json whole = job.see(job.post("/camera", {{"distance", 0}}), false);
    if (!(whole["frame"]["distance"] > 1)) // far enough that the whole grid is in the image
        fail("a distance of " + whole["frame"]["distance"].dump());
    job.post("/command", {{"command", "go"}});
    for (int last = at; last < at + 100;)
        last = job.see(0, false)["frame"]["step"].get<int>();
}

void taken(const Job& job, char** command)
{
    const std::string port = std::to_string(job.port());
    std::vector<char*> words;
    for (char** word = command; *word; ++word)
        words.push_back(*word);
    words.back() = const_cast<char*>(port.c_str());
    words.push_back(nullptr);
    const pid_t other = fork();
    if (other == 0) {
        execvp(words[0], words.data());
        _exit(127);
    }
    int status = 0;
    waitpid(other, &status, 0);
    if (!WIFEXITED(status) || WEXITSTATUS(status) != 1)
        fail("a second job on that port has not ended with 1");
}

} // namespace

int main(int argc, char** argv)
try {
    if (argc < 3)
        fail("usage: job CASE COMMAND...");
    const std::string which = argv[1];
    Job job(argv + 2);
    job.see(0, false);
    if (which == "rest")
        rest(job);
    else if (which == "fire")
        fire(job);
    else if (which == "step")
        step(job);
    else if (which == "taken")
        taken(job, argv + 2);
    if (which == "interrupt" || which == "killed")
        job.interrupt();
    else
        job.post("/command", {{"command", "end"}});
    job.expectEnd(which == "killed" ? 1 : 0);
    return 0;
} catch (const std::exception& e) {
    std::fprintf(stderr, "job: %s\n", e.what());
    return 1;
}
