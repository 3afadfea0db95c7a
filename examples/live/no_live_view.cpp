// LiveView for builds without the packages that it needs: listen() only throws.
#include "live_view.hpp"

#include <stdexcept>

namespace example {

std::unique_ptr<LiveView> LiveView::listen(const std::string&, int, bool)
{
    throw std::runtime_error("--live: this program was built without it; Debian and Ubuntu packages that were "
                             "missing: " DFB_LIVE_MISSING);
}

} // namespace example
