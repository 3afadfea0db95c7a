// LiveView where the packages that it needs are missing: it cannot be made.
#include "live_view.hpp"

#include <stdexcept>

namespace example {

std::unique_ptr<LiveView> LiveView::listen(const std::string&, int, bool)
{
    throw std::runtime_error("--live: this program was built without it; Debian and Ubuntu packages that were "
                             "missing: " DFB_LIVE_MISSING);
}

} // namespace example
