// FramePattern: the name of a file, or of one file per frame: frame_%04d.png.
#pragma once

#include <algorithm>
#include <cstddef>
#include <stdexcept>
#include <string>

namespace example {

// In a pattern %d stands for the number of the frame, from 0 on, and %0Nd (N from 1 to 9) for the number with at least
// N digits. %% is a percent sign.
class FramePattern {
public:
    // Throws std::invalid_argument if a % begins anything else, or if there is more than one number.
    explicit FramePattern(const std::string& text)
    {
        for (std::size_t at = 0; at < text.size(); ++at) {
            std::string& part = isPattern_ ? behind_ : front_;
            if (text[at] != '%') {
                part += text[at];
            } else if (text.compare(at, 2, "%%") == 0) {
                part += text[++at];
            } else {
                const bool hasDigits = text.compare(at, 2, "%0") == 0 && at + 2 < text.size() && text[at + 2] >= '1'
                                       && text[at + 2] <= '9';
                const std::size_t letter = at + (hasDigits ? 3 : 1);
                if (isPattern_ || letter >= text.size() || text[letter] != 'd')
                    throw std::invalid_argument("'" + text
                                                + "': % must be %% for a percent sign, or once %d or as %04d for the "
                                                  "number of the frame");
                digits_ = hasDigits ? static_cast<std::size_t>(text[at + 2] - '0') : 1;
                isPattern_ = true;
                at = letter;
            }
        }
    }

    // Whether there is one file per frame.
    bool isPattern() const { return isPattern_; }

    std::string path(int frame) const
    {
        if (!isPattern_)
            return front_;
        const std::string number = std::to_string(frame);
        return front_ + std::string(digits_ - std::min(digits_, number.size()), '0') + number + behind_;
    }

private:
    std::string front_, behind_;
    bool isPattern_ = false;
    std::size_t digits_ = 1;
};

} // namespace example
