// LiveView where the packages that it needs are missing: it cannot be made.
#include "live_view.hpp"

#include <stdexcept>

namespace example {

class LiveView::Server {};

LiveView::LiveView(const std::string&, int, bool)
{
    throw std::runtime_error("--live: this program was built without it; Debian and Ubuntu packages that were "
                             "missing: " DFB_LIVE_MISSING);
}
LiveView::~LiveView() = default;

const std::string& LiveView::url() const
{
    static const std::string none;
    return none;
}
void LiveView::open(const LiveScene&, const LiveWishes&) {}
LiveWishes LiveView::wishes() const { return {}; }
LiveWishes LiveView::waitForChange(std::uint64_t, std::chrono::milliseconds) const { return {}; }
bool LiveView::hasMoved(std::uint64_t) const { return false; }
void LiveView::whileWatching(std::uint64_t, const std::function<void()>&, const std::function<void()>& work) { work(); }
void LiveView::show(const std::uint8_t*, int, int, const dfb::FrameReport&, LivePicture) {}

} // namespace example
