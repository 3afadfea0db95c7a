// MpiRanks: the ranks of an MpiTransport. When it is made, they duplicate the caller's communicator, compare the
// formats of their packets, and share memory with the ranks of their node.
//
// In every version of this file, ranks first duplicate the communicator and gather the 8 bytes of their packetFormat on
// it. No version may change that.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/base/processors.hpp>
#include <dfb/buffer.hpp>
#include <dfb/comm/mpi_calls.hpp>
#include <dfb/comm/node_memory.hpp>
#include <dfb/comm/packet.hpp>
#include <dfb/error.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

namespace detail {

class MpiRanks {
public:
    // A rank as this one sees it.
    struct Other {
        std::shared_ptr<NodeMemory> itsMemory; // null: this rank does not see it
        bool seesMine = false;                 // whether it sees the memory of this rank
    };

    // Collective over `communicator`. Throws InvalidArgument for MPI_COMM_NULL or an intercommunicator; TransportError
    // on all ranks if they were built with different packet formats, and on one alone if a collective of MPI fails
    // there. firstFailed() tells all ranks of anything else that goes wrong on one.
    MpiRanks(MPI_Comm communicator, MemoryPool& pool)
    {
        if (communicator == MPI_COMM_NULL)
            failArgument("the communicator is MPI_COMM_NULL: only ranks that have one can take part");
        if (int isInter = 0; MPI_Comm_test_inter(communicator, &isInter) == MPI_SUCCESS && isInter)
            failArgument("the communicator is an intercommunicator: make one of both groups by MPI_Intercomm_merge()");
        MPI_Request duplicated = MPI_REQUEST_NULL;
        check(MPI_Comm_idup(communicator, &comm_, &duplicated), "MPI_Comm_idup");
        waitMpi(duplicated, rank_);
        check(MPI_Comm_rank(comm_, &rank_), "MPI_Comm_rank");
        check(MPI_Comm_size(comm_, &size_), "MPI_Comm_size");
        attempt([this] {
            check(MPI_Comm_set_errhandler(comm_, MPI_ERRORS_RETURN), "MPI_Comm_set_errhandler");
            others_.resize(static_cast<std::size_t>(size_));
        });
        try {
            compareFormats();
        } catch (...) {
            MPI_Comm_free(&comm_);
            throw;
        }
        meetNode(pool);
    }

    // Runs a step that a rank does alone. A rank that fails does no more such steps. It still takes part in the steps
    // of all ranks, which would wait for it, until firstFailed() tells them.
    void attempt(FunctionRef<void()> step)
    {
        if (wrong_[0] != 0)
            return;
        try {
            step();
        } catch (const Error& e) {
            std::snprintf(wrong_.data(), wrong_.size(), "%s", e.info().message.c_str());
        } catch (const std::exception& e) {
            std::snprintf(wrong_.data(), wrong_.size(), "%s", e.what());
        }
    }

    // Returns the first rank on which a step has failed, for reason(), or size() if there is none. Collective.
    int firstFailed()
    {
        const int mine = wrong_[0] != 0 ? rank_ : size_;
        int first = size_;
        MPI_Request request = MPI_REQUEST_NULL;
        check(MPI_Iallreduce(&mine, &first, 1, MPI_INT, MPI_MIN, comm_, &request), "MPI_Iallreduce");
        waitMpi(request, rank_);
        if (first < size_) {
            check(MPI_Ibcast(wrong_.data(), static_cast<int>(wrong_.size()), MPI_CHAR, first, comm_, &request),
                  "MPI_Ibcast");
            waitMpi(request, rank_);
        }
        return first;
    }
    const char* reason() const noexcept { return wrong_.data(); }

    MPI_Comm comm() const noexcept { return comm_; }   // the duplicate; MPI_COMM_NULL after free() or abandon()
    void free() { MPI_Comm_free(&comm_); }             // collective
    void abandon() noexcept { comm_ = MPI_COMM_NULL; } // MPI keeps it
    int rank() const noexcept { return rank_; }
    int size() const noexcept { return size_; }
    const Other& operator[](int other) const noexcept { return others_[static_cast<std::size_t>(other)]; }

    // This rank's memory, if another rank sees it; else null.
    const std::shared_ptr<NodeMemory>& memory() const noexcept { return memory_; }
    bool doAllSeeMine() const noexcept { return doAllSeeMine_; }
    // How many ranks of this node, including this one, may run on this rank's processors.
    int sharingRanks() const noexcept { return sharingRanks_; }

private:
    void check(int code, const char* call) const { checkMpi(code, call, rank_); }

    // Returns the values of all ranks, on all ranks.
    template <class T>
    std::vector<T> gather(const T& mine) const
    {
        std::vector<T> all(static_cast<std::size_t>(size_));
        MPI_Request request = MPI_REQUEST_NULL;
        check(MPI_Iallgather(&mine, sizeof mine, MPI_BYTE, all.data(), sizeof mine, MPI_BYTE, comm_, &request),
              "MPI_Iallgather");
        waitMpi(request, rank_);
        return all;
    }

    // Throws the same TransportError on all ranks.
    void compareFormats() const
    {
        using Format = unsigned long long; // as printf() names it; of 8 bytes
        const std::vector<Format> all = gather(Format{packetFormat});
        const auto differs = std::find_if(all.begin(), all.end(), [&](Format f) { return f != all.front(); });
        if (differs == all.end())
            return;
        const int other = static_cast<int>(differs - all.begin());
        std::string text = printed("ranks were built with versions of dfb that cannot read each other: rank 0 sends "
                                   "packets of format %llu",
                                   all.front());
        int named = 0; // those that differ from rank 0
        for (std::size_t rank = 0; rank < all.size(); ++rank)
            if (all[rank] != all.front() && ++named <= 8)
                text += printed(", rank %zu of format %llu", rank, all[rank]);
        if (named > 8)
            text += printed(", and %d more of others than rank 0", named - 8);
        throw TransportError(std::move(text), other);
    }

    // A rank's message to all others in meetNode().
    struct Card {
        std::uint64_t host;
        Processors processors;
        NodeMemory::Address memory;
    };

    // Finds the ranks of this node, and shares memory with those that it can be shared with.
    void meetNode(MemoryPool& pool)
    {
        std::shared_ptr<NodeMemory> memory;
        Card mine{};
        attempt([&] {
            memory = memoryToShare(pool);
            mine = {hostOfThis(), Processors::ofThisThread(), memory ? memory->address() : NodeMemory::Address()};
        });
        const std::vector<Card> all = gather(mine);
        sharingRanks_ = static_cast<int>(std::count_if(all.begin(), all.end(), [&](const Card& card) {
            return card.host == mine.host && card.processors.meets(mine.processors);
        }));

        // Each tells the others whose memory it sees.
        std::vector<std::uint8_t> sees(all.size()), seen(all.size());
        attempt([&] {
            for (std::size_t i = 0; i < all.size() && memory; ++i)
                if (static_cast<int>(i) != rank_ && all[i].host == mine.host) {
                    others_[i].itsMemory = NodeMemory::open(all[i].memory);
                    sees[i] = others_[i].itsMemory != nullptr;
                }
        });
        MPI_Request request = MPI_REQUEST_NULL;
        check(MPI_Ialltoall(sees.data(), 1, MPI_BYTE, seen.data(), 1, MPI_BYTE, comm_, &request), "MPI_Ialltoall");
        waitMpi(request, rank_);
        attempt([&] {
            for (std::size_t i = 0; i < all.size(); ++i)
                others_[i].seesMine = seen[i] != 0;
            const auto seers = std::count(seen.begin(), seen.end(), 1);
            if (seers > 0) {
                pool.share(memory);
                memory_ = memory;
            }
            doAllSeeMine_ = seers == size_ - 1;
        });
    }

    std::uint64_t hostOfThis() const
    {
        char host[MPI_MAX_PROCESSOR_NAME + 1] = {};
        int length = 0;
        check(MPI_Get_processor_name(host, &length), "MPI_Get_processor_name");
        return std::hash<std::string>()(std::string(host, static_cast<std::size_t>(length)));
    }

    std::shared_ptr<NodeMemory> memoryToShare(const MemoryPool& pool) const
    {
        if (size_ == 1 || !pool.mayBeShared())
            return nullptr;
        if (const auto has = std::dynamic_pointer_cast<NodeMemory>(pool.shared()))
            return has; // of another transport with this pool
        return NodeMemory::create();
    }

    MPI_Comm comm_ = MPI_COMM_NULL;
    int rank_ = 0, size_ = 1;
    int sharingRanks_ = 1;
    std::vector<Other> others_;
    std::shared_ptr<NodeMemory> memory_;
    bool doAllSeeMine_ = false;
    // Why this rank can have no transport; empty if nothing is wrong. An array, as there may be no memory for a string.
    std::array<char, 512> wrong_{};
};

} // namespace detail

DFB_NAMESPACE_END
