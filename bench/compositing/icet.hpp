// IceT, the compositing library of ParaView, as a peer to compare with: blends the images of all ranks, in order, into
// one on rank 0. get_icet.sh gets it; the target bench_icet has it, and defines DFB_BENCH_HAS_ICET.
#pragma once

#include "baselines.hpp"

#include <IceT.h>

#include <memory>
#include <stdexcept>

namespace bench {

// A way to composite, and its name for a table. ICET_STRATEGY_DIRECT ignores `singleImage`.
struct IceTStrategy {
    const char* name;
    IceTEnum strategy, singleImage;
};

// All strategies that keep an order; ICET_STRATEGY_SPLIT and ICET_STRATEGY_VTREE do not. Sequential is what IceT's
// manual advises for one tile. Reduce leaves ranks out that have nothing in the image, for which it asks all of them
// first.
inline std::vector<IceTStrategy> icetStrategies()
{
    return {
        {"sequential, automatic", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
        {"sequential, binary swap", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_BSWAP},
        {"sequential, folding swap", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_BSWAP_FOLDING},
        {"sequential, tree", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_TREE},
        {"sequential, radix-k", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_RADIXK},
        {"sequential, radix-kr", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_RADIXKR},
        {"reduce, automatic", ICET_STRATEGY_REDUCE, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
        {"reduce, binary swap", ICET_STRATEGY_REDUCE, ICET_SINGLE_IMAGE_STRATEGY_BSWAP},
        {"reduce, folding swap", ICET_STRATEGY_REDUCE, ICET_SINGLE_IMAGE_STRATEGY_BSWAP_FOLDING},
        {"reduce, tree", ICET_STRATEGY_REDUCE, ICET_SINGLE_IMAGE_STRATEGY_TREE},
        {"reduce, radix-k", ICET_STRATEGY_REDUCE, ICET_SINGLE_IMAGE_STRATEGY_RADIXK},
        {"reduce, radix-kr", ICET_STRATEGY_REDUCE, ICET_SINGLE_IMAGE_STRATEGY_RADIXKR},
        {"direct", ICET_STRATEGY_DIRECT, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
    };
}

// ---- MPI for IceT

// What a rank has sent to others. A collective call counts as what the rank must send if no rank forwards data of
// others.
struct IceTTraffic {
    std::int64_t bytes = 0, messages = 0;
};

// A communicator for IceT, which tests, and gives up its time slice in between, while it waits.
class IceTMpi : public IceTCommunicatorStruct {
public:
    // The communicator and `traffic` remain the caller's. IceT duplicates this object.
    IceTMpi(MPI_Comm comm, IceTTraffic& traffic) : IceTCommunicatorStruct{}, comm_(comm), traffic_(&traffic)
    {
        MPI_Comm_rank(comm_, &rank_);
        MPI_Comm_size(comm_, &size_);
        Duplicate = [](IceTCommunicator self) -> IceTCommunicator { return of(self).duplicate(); };
        Destroy = [](IceTCommunicator self) {
            MPI_Comm_free(&of(self).comm_);
            delete &of(self);
        };
        Subset = [](IceTCommunicator self, int count, const IceTInt32* ranks) { return of(self).subset(count, ranks); };
        Comm_size = [](IceTCommunicator self) { return of(self).size_; };
        Comm_rank = [](IceTCommunicator self) { return of(self).rank_; };
        setPointToPoint();
        setCollectives();
    }
    IceTMpi(const IceTMpi&) = delete;
    IceTMpi& operator=(const IceTMpi&) = delete;

private:
    struct Request : IceTCommRequestStruct {
        MPI_Request request = MPI_REQUEST_NULL;
    };

    struct Type {
        MPI_Datatype mpi;
        std::int64_t bytes;
    };

    static IceTMpi& of(IceTCommunicator self) { return *static_cast<IceTMpi*>(self); }

    static MPI_Request& of(IceTCommRequest request) { return static_cast<Request*>(request)->request; }

    static Type typeOf(IceTEnum type)
    {
        switch (type) {
        case ICET_BOOLEAN:
        case ICET_BYTE: return {MPI_BYTE, 1};
        case ICET_SHORT: return {MPI_SHORT, sizeof(IceTShort)};
        case ICET_INT: return {MPI_INT, sizeof(IceTInt)};
        case ICET_FLOAT: return {MPI_FLOAT, sizeof(IceTFloat)};
        case ICET_DOUBLE: return {MPI_DOUBLE, sizeof(IceTDouble)};
        default: std::fprintf(stderr, "IceT sends data of an unknown type\n"); std::abort();
        }
    }

    // What IceT calls ICET_IN_PLACE_COLLECT, in a header that is not installed.
    static const void* inPlaceOr(const void* data)
    {
        return data == reinterpret_cast<const void*>(std::intptr_t{-1}) ? MPI_IN_PLACE : data;
    }

    IceTMpi* duplicate() const
    {
        MPI_Comm copy = MPI_COMM_NULL;
        MPI_Request request = MPI_REQUEST_NULL;
        MPI_Comm_idup(comm_, &copy, &request);
        complete(request);
        return new IceTMpi(copy, *traffic_);
    }

    // The only call that waits inside MPI, which has no other way; IceT does not make it while it composites.
    IceTCommunicator subset(int count, const int* ranks) const
    {
        MPI_Group all = MPI_GROUP_NULL, some = MPI_GROUP_NULL;
        MPI_Comm_group(comm_, &all);
        MPI_Group_incl(all, count, ranks, &some);
        MPI_Comm comm = MPI_COMM_NULL;
        MPI_Comm_create(comm_, some, &comm);
        MPI_Group_free(&some);
        MPI_Group_free(&all);
        return comm == MPI_COMM_NULL ? nullptr : new IceTMpi(comm, *traffic_);
    }

    void count(std::int64_t messages, std::int64_t bytesEach)
    {
        traffic_->messages += messages;
        traffic_->bytes += messages * bytesEach;
    }

    MPI_Request send(const void* buffer, int number, IceTEnum type, int to, int tag)
    {
        count(to == rank_ ? 0 : 1, number * typeOf(type).bytes);
        MPI_Request request = MPI_REQUEST_NULL;
        MPI_Isend(buffer, number, typeOf(type).mpi, to, tag, comm_, &request);
        return request;
    }

    MPI_Request receive(void* buffer, int number, IceTEnum type, int from, int tag)
    {
        MPI_Request request = MPI_REQUEST_NULL;
        MPI_Irecv(buffer, number, typeOf(type).mpi, from, tag, comm_, &request);
        return request;
    }

    static IceTCommRequest wrap(MPI_Request request)
    {
        auto* wrapped = new Request{};
        wrapped->request = request;
        return wrapped;
    }

    static void destroy(IceTCommRequest& request)
    {
        delete static_cast<Request*>(request);
        request = ICET_COMM_REQUEST_NULL;
    }

    static int waitAny(int number, IceTCommRequest* requests)
    {
        std::vector<MPI_Request> all;
        for (int i = 0; i < number; ++i)
            all.push_back(requests[i] == ICET_COMM_REQUEST_NULL ? MPI_REQUEST_NULL : of(requests[i]));
        int index = MPI_UNDEFINED, done = 0;
        Idler idler(Waiting::Yield);
        while (MPI_Testany(number, all.data(), &index, &done, MPI_STATUS_IGNORE), !done)
            idler.idle();
        if (index == MPI_UNDEFINED)
            return -1;
        destroy(requests[index]);
        return index;
    }

    void setPointToPoint()
    {
        Send = [](IceTCommunicator self, const void* buffer, int number, IceTEnum type, int to, int tag) {
            MPI_Request request = of(self).send(buffer, number, type, to, tag);
            complete(request);
        };
        Recv = [](IceTCommunicator self, void* buffer, int number, IceTEnum type, int from, int tag) {
            MPI_Request request = of(self).receive(buffer, number, type, from, tag);
            complete(request);
        };
        Sendrecv = [](IceTCommunicator self, const void* sent, int sentNumber, IceTEnum sentType, int to, int sentTag,
                      void* received, int number, IceTEnum type, int from, int tag) {
            MPI_Request receiving = of(self).receive(received, number, type, from, tag);
            MPI_Request sending = of(self).send(sent, sentNumber, sentType, to, sentTag);
            complete(sending);
            complete(receiving);
        };
        Isend = [](IceTCommunicator self, const void* buffer, int number, IceTEnum type, int to, int tag) {
            return wrap(of(self).send(buffer, number, type, to, tag));
        };
        Irecv = [](IceTCommunicator self, void* buffer, int number, IceTEnum type, int from, int tag) {
            return wrap(of(self).receive(buffer, number, type, from, tag));
        };
        Wait = [](IceTCommunicator, IceTCommRequest* request) {
            if (*request == ICET_COMM_REQUEST_NULL)
                return;
            complete(of(*request));
            destroy(*request);
        };
        Waitany = [](IceTCommunicator, int number, IceTCommRequest* requests) { return waitAny(number, requests); };
    }

    void setCollectives()
    {
        Barrier = [](IceTCommunicator self) {
            IceTMpi& mpi = of(self);
            for (int reach = 1; reach < mpi.size_; reach *= 2)
                mpi.count(1, 0);
            MPI_Request request = MPI_REQUEST_NULL;
            MPI_Ibarrier(mpi.comm_, &request);
            complete(request);
        };
        Gather = [](IceTCommunicator self, const void* sent, int number, IceTEnum type, void* received, int root) {
            IceTMpi& mpi = of(self);
            mpi.count(mpi.rank_ == root ? 0 : 1, number * typeOf(type).bytes);
            MPI_Request request = MPI_REQUEST_NULL;
            MPI_Igather(inPlaceOr(sent), number, typeOf(type).mpi, received, number, typeOf(type).mpi, root, mpi.comm_,
                        &request);
            complete(request);
        };
        Gatherv = [](IceTCommunicator self, const void* sent, int number, IceTEnum type, void* received,
                     const int* numbers, const int* places, int root) {
            IceTMpi& mpi = of(self);
            mpi.count(mpi.rank_ == root || number == 0 ? 0 : 1, number * typeOf(type).bytes);
            MPI_Request request = MPI_REQUEST_NULL;
            MPI_Igatherv(inPlaceOr(sent), number, typeOf(type).mpi, received, numbers, places, typeOf(type).mpi, root,
                         mpi.comm_, &request);
            complete(request);
        };
        Allgather = [](IceTCommunicator self, const void* sent, int number, IceTEnum type, void* received) {
            IceTMpi& mpi = of(self);
            mpi.count(mpi.size_ - 1, number * typeOf(type).bytes);
            MPI_Request request = MPI_REQUEST_NULL;
            MPI_Iallgather(inPlaceOr(sent), number, typeOf(type).mpi, received, number, typeOf(type).mpi, mpi.comm_,
                           &request);
            complete(request);
        };
        Alltoall = [](IceTCommunicator self, const void* sent, int number, IceTEnum type, void* received) {
            IceTMpi& mpi = of(self);
            mpi.count(mpi.size_ - 1, number * typeOf(type).bytes);
            MPI_Request request = MPI_REQUEST_NULL;
            MPI_Ialltoall(inPlaceOr(sent), number, typeOf(type).mpi, received, number, typeOf(type).mpi, mpi.comm_,
                          &request);
            complete(request);
        };
    }

    MPI_Comm comm_;
    int rank_ = 0, size_ = 1;
    IceTTraffic* traffic_;
};

// ---- IceT

// One image of all ranks. IceT knows one context at a time per process: use all IceTs from one thread.
class IceT {
public:
    // `ubyte`: colours are 4 bytes, not 4 floats. Collective, as is the destructor, which must come before
    // MPI_Finalize. Throws std::runtime_error.
    IceT(MPI_Comm comm, const IceTStrategy& strategy, bool ubyte, int width, int height) : ubyte_(ubyte)
    {
        MPI_Comm_rank(comm, &rank_);
        MPI_Comm_size(comm, &size_);
        IceTMpi mpi(comm, traffic_);
        context_.reset(icetCreateContext(&mpi)); // makes a duplicate of `mpi`
        icetSetContext(context_.get());
        icetDiagnostics(ICET_DIAG_WARNINGS | ICET_DIAG_ALL_NODES);
        icetSetColorFormat(ubyte_ ? ICET_IMAGE_COLOR_RGBA_UBYTE : ICET_IMAGE_COLOR_RGBA_FLOAT);
        icetSetDepthFormat(ICET_IMAGE_DEPTH_NONE);
        icetCompositeMode(ICET_COMPOSITE_MODE_BLEND);
        icetEnable(ICET_ORDERED_COMPOSITE);
        icetEnable(ICET_INTERLACE_IMAGES); // IceT's default: pixels are shuffled, to balance the work
        icetStrategy(strategy.strategy);
        icetSingleImageStrategy(strategy.singleImage);
        icetResetTiles();
        icetAddTile(0, 0, width, height, 0);
        check();
        resetTraffic();
    }
    IceT(const IceT&) = delete;
    IceT& operator=(const IceT&) = delete;

    // Collective: blends the images of all ranks with "over". `order` has the ranks from front to back, the same on
    // all. `colour` is this rank's whole image, premultiplied RGBA in rows without gaps, floats or bytes (at an address
    // divisible by 4) as said at first; `viewport` (x, y, width, height) the part outside of which it is ignored,
    // which may be empty. Where alpha is 0 IceT takes a pixel for empty, whatever its colour. On rank 0 returns the
    // image, likewise, which is IceT's until the next call; elsewhere null. Throws std::runtime_error.
    const void* composite(const void* colour, const int viewport[4], const std::vector<int>& order)
    {
        constexpr IceTDouble identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
        constexpr IceTFloat background[4] = {0, 0, 0, 0};
        if (order.size() != static_cast<std::size_t>(size_))
            throw std::runtime_error("IceT needs each rank in the order");
        icetSetContext(context_.get());
        icetCompositeOrder(order.data());
        const IceTImage image = icetCompositeImage(colour, nullptr, viewport, identity, identity, background);
        check();
        if (rank_ != 0)
            return nullptr;
        return ubyte_ ? static_cast<const void*>(icetImageGetColorcub(image)) : icetImageGetColorcf(image);
    }

    // Sent by this rank to others since the last reset.
    std::int64_t bytesSent() const { return traffic_.bytes; }
    std::int64_t messagesSent() const { return traffic_.messages; }
    void resetTraffic() { traffic_ = {}; }

private:
    // IceT has printed the error already.
    static void check()
    {
        if (icetGetError() != ICET_NO_ERROR)
            throw std::runtime_error("IceT reports an error or a warning");
    }

    bool ubyte_;
    int rank_ = 0, size_ = 1;
    IceTTraffic traffic_;
    std::unique_ptr<IceTContextStruct, decltype(&icetDestroyContext)> context_{nullptr, icetDestroyContext};
};

} // namespace bench
