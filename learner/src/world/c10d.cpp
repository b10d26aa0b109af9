// The collective operations of several learners, by c10d's gloo: see `c10d.rs`.

#include <ATen/core/Tensor.h>
#include <torch/csrc/distributed/c10d/ProcessGroupGloo.hpp>
#include <torch/csrc/distributed/c10d/TCPStore.hpp>

#include <algorithm>
#include <chrono>
#include <cstring>
#include <exception>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

namespace {

using Group = c10d::ProcessGroupGloo;

// Whether `call` succeeds. If it throws, the reason is in `message`.
template <typename Call>
bool attempt(char* message, size_t room, Call call) {
  std::string why;
  try {
    call();
    return true;
  } catch (const std::exception& error) {
    why = error.what();
  } catch (...) {
    why = "an exception of another kind";
  }
  const size_t length = std::min(why.size(), room);
  std::memcpy(message, why.data(), length);
  std::memset(message + length, 0, room - length);
  return false;
}

}  // namespace

// Meets the other ranks at `host` and `port`. Rank 0 listens there, on the socket `listener`, which this takes over; other ranks give a
// negative number. `address` is an address of this machine, on which its connections to the other ranks begin and end. If rank 0 has
// another size, that is in `size_of_first`, and there is no group: ranks would wait for one that never comes.
extern "C" Group* comic_world_meet(const char* host, uint16_t port, int listener, const char* address, int rank,
                                   int size, int64_t patience_ms, int* size_of_first, char* message, size_t room) {
  Group* group = nullptr;
  attempt(message, room, [&] {
    // gloo reports its connections on the standard output, where the learner's own line belongs. No other C++ writes there.
    static const bool silenced = (std::cout.rdbuf(nullptr), true);
    (void)silenced;
    const std::chrono::milliseconds patience(patience_ms);
    c10d::TCPStoreOptions meet;
    meet.port = port;
    meet.isServer = rank == 0;
    // gloo waits for all ranks below.
    meet.waitWorkers = false;
    meet.timeout = patience;
    if (listener >= 0) meet.masterListenFd = listener;
    const c10::intrusive_ptr<c10d::Store> store = c10::make_intrusive<c10d::TCPStore>(host, meet);
    if (rank == 0) store->set("size", std::to_string(size));
    *size_of_first = std::stoi(store->get_to_str("size"));
    if (*size_of_first != size) return;
    const auto options = Group::Options::create(patience);
    options->devices.push_back(Group::createDeviceForHostname(address));
    options->threads = 1;
    group = c10::make_intrusive<Group>(store, rank, size, options).release();
  });
  return group;
}

extern "C" void comic_world_wait_for(Group* group, int64_t patience_ms) {
  group->setTimeout(std::chrono::milliseconds(patience_ms));
}

// The sum over all ranks, in place. The tensor is contiguous and on the CPU, as all tensors here.
extern "C" bool comic_world_sum(Group* group, const at::Tensor* tensor, char* message, size_t room) {
  return attempt(message, room, [&] {
    std::vector<at::Tensor> tensors{*tensor};
    group->allreduce(tensors)->wait();
  });
}

// The tensors of all ranks, in the order of the ranks, into `all`.
extern "C" bool comic_world_gather(Group* group, const at::Tensor* tensor, const at::Tensor* all, char* message,
                                   size_t room) {
  return attempt(message, room, [&] {
    at::Tensor input = *tensor, output = *all;
    group->_allgather_base(output, input)->wait();
  });
}

// The tensor of rank 0 into that of all others.
extern "C" bool comic_world_broadcast(Group* group, const at::Tensor* tensor, char* message, size_t room) {
  return attempt(message, room, [&] {
    std::vector<at::Tensor> tensors{*tensor};
    group->broadcast(tensors)->wait();
  });
}

extern "C" void comic_world_leave(Group* group) { c10::intrusive_ptr<Group>::reclaim(group); }
