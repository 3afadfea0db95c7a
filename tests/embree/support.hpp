// Shared by the tests of the bundled renderer: error texts, and a temporary folder.
#pragma once

#include "catch.hpp"

#include <atomic>
#include <chrono>
#include <exception>
#include <filesystem>
#include <fstream>
#include <string>

namespace test {

// The message of the exception that `function` throws, or "" if it throws none.
template <class Function>
std::string errorOf(const Function& function)
{
    try {
        function();
    } catch (const std::exception& e) {
        return std::string(e.what()).empty() ? "an exception without a text" : e.what();
    }
    return {};
}

inline bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

// Whether `text` is a single line that contains `part`.
inline bool isLineWith(const std::string& text, const std::string& part)
{
    return contains(text, part) && !contains(text, "\n");
}

class TemporaryFolder {
public:
    TemporaryFolder()
    {
        static std::atomic<int> count{0};
        const auto now = std::chrono::steady_clock::now().time_since_epoch().count();
        path_ = std::filesystem::temp_directory_path()
                / ("dfb_render_test_" + std::to_string(now) + "_" + std::to_string(++count));
        if (!std::filesystem::create_directory(path_))
            throw std::runtime_error(path_.string() + " exists");
    }
    ~TemporaryFolder()
    {
        std::error_code ignored;
        std::filesystem::remove_all(path_, ignored);
    }
    TemporaryFolder(const TemporaryFolder&) = delete;
    TemporaryFolder& operator=(const TemporaryFolder&) = delete;

    std::string operator/(const std::string& name) const { return (path_ / name).string(); }

    std::string write(const std::string& name, const std::string& bytes) const
    {
        std::ofstream(path_ / name, std::ios::binary) << bytes;
        return *this / name;
    }

private:
    std::filesystem::path path_;
};

} // namespace test
