// A sink must not throw, as it is called in destructors and with locks held.
#include <dfb/trace.hpp>

class Sink final : public dfb::TraceSink {
public:
#if defined(CASE_MAY_THROW) // expect: exception specification
    void add(const dfb::TraceEvent& event) override { throw event; }
#else
    void add(const dfb::TraceEvent&) noexcept override {}
#endif
};

int main() { return Sink().add({}), 0; }
