// Times, figures and tables of the benchmarks, without MPI.
#pragma once

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace bench {

// ---- time

using Clock = std::chrono::steady_clock;

// On Linux the same for all processes of a node.
inline double now() { return std::chrono::duration<double>(Clock::now().time_since_epoch()).count(); }

inline double cpuSeconds(clockid_t clock)
{
    timespec t{};
    clock_gettime(clock, &t);
    return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}
inline double processCpuSeconds() { return cpuSeconds(CLOCK_PROCESS_CPUTIME_ID); }
inline double threadCpuSeconds() { return cpuSeconds(CLOCK_THREAD_CPUTIME_ID); }

// ---- figures and tables

// The median absolute deviation: half of the samples are no farther than that from the median. At most a quarter of the
// samples is below `low`, at most a quarter above `high`.
struct Figure {
    double median = 0, deviation = 0;
    std::size_t count = 0;
    double low = 0, high = 0;
};

inline double medianOf(std::vector<double>& samples)
{
    if (samples.empty())
        return 0;
    const auto middle = samples.begin() + static_cast<std::ptrdiff_t>(samples.size() / 2);
    std::nth_element(samples.begin(), middle, samples.end());
    if (samples.size() % 2 == 1)
        return *middle;
    return (*middle + *std::max_element(samples.begin(), middle)) / 2;
}

inline Figure figureOf(std::vector<double> samples)
{
    Figure figure;
    figure.count = samples.size();
    figure.median = medianOf(samples);
    if (!samples.empty()) {
        std::sort(samples.begin(), samples.end());
        figure.low = samples[(samples.size() - 1) / 4];
        figure.high = samples[samples.size() - 1 - (samples.size() - 1) / 4];
    }
    for (double& sample : samples)
        sample = std::abs(sample - figure.median);
    figure.deviation = medianOf(samples);
    return figure;
}

// The value with three digits.
inline std::string text(double value)
{
    char out[32];
    const double size = std::abs(value);
    std::snprintf(out, sizeof out, "%.*f", size >= 99.95 || size == 0 ? 0 : size >= 9.995 ? 1 : 2, value);
    return out;
}

// As printf() writes it.
inline std::string text(const char* format, double value)
{
    char out[64];
    std::snprintf(out, sizeof out, format, value);
    return out;
}

inline std::string text(const Figure& figure)
{
    return figure.count == 0 ? "-" : text(figure.median) + " ±" + text(figure.deviation);
}

inline std::string byteText(std::size_t byteCount)
{
    return byteCount >= (1u << 20) && byteCount % (1u << 20) == 0   ? std::to_string(byteCount >> 20) + " MiB"
           : byteCount >= (1u << 10) && byteCount % (1u << 10) == 0 ? std::to_string(byteCount >> 10) + " KiB"
                                                                    : std::to_string(byteCount) + " B";
}

// Does nothing if the path is empty. Throws std::runtime_error if the file cannot be written.
inline void appendTo(const std::string& path, const std::string& what)
{
    if (path.empty())
        return;
    std::ofstream file(path, std::ios::app);
    file << what;
    if (!file.flush())
        throw std::runtime_error("cannot write " + path);
}

class Table {
public:
    explicit Table(std::vector<std::string> head) : rows_{std::move(head)} {}
    void add(std::vector<std::string> row) { rows_.push_back(std::move(row)); }

    void print(const std::string& title) const
    {
        std::printf("\n%s\n%s", title.c_str(), text().c_str());
        std::fflush(stdout);
    }

    std::string text() const
    {
        std::vector<std::size_t> widths(rows_.front().size());
        for (const auto& row : rows_)
            for (std::size_t i = 0; i < row.size(); ++i)
                widths[i] = std::max(widths[i], lettersOf(row[i]));
        std::string out;
        for (std::size_t r = 0; r < rows_.size(); ++r) {
            for (std::size_t i = 0; i < rows_[r].size(); ++i) {
                const std::string space(widths[i] - lettersOf(rows_[r][i]), ' ');
                out += (i == 0 ? "| " + rows_[r][i] + space : ' ' + space + rows_[r][i]) + " |";
            }
            out += '\n';
            for (std::size_t i = 0; r == 0 && i < widths.size(); ++i)
                out += (i == 0 ? "|" : "") + std::string(widths[i] + 1, '-') + (i == 0 ? "-|" : ":|");
            out += r == 0 ? "\n" : "";
        }
        return out;
    }

    // Appends the table to a file, if the path is not empty.
    void appendTo(const std::string& path, const std::string& title) const
    {
        bench::appendTo(path, '\n' + title + "\n\n" + text());
    }

private:
    // The number of letters of a text in UTF-8.
    static std::size_t lettersOf(const std::string& s)
    {
        return static_cast<std::size_t>(
            std::count_if(s.begin(), s.end(), [](char c) { return (static_cast<unsigned char>(c) & 0xc0) != 0x80; }));
    }

    std::vector<std::vector<std::string>> rows_;
};

// The largest difference of two images; NaN if one of the differences is; 0 where there are none.
inline double differenceOf(const float* a, const float* b, std::size_t values)
{
    double largest = 0;
    for (std::size_t i = 0; a && b && i < values && !std::isnan(largest); ++i) {
        const double d = std::abs(static_cast<double>(a[i]) - static_cast<double>(b[i]));
        largest = d <= largest ? largest : d;
    }
    return largest;
}

} // namespace bench
