// Copies to a card on a stream of their own: tch knows neither streams nor memory that a card can read by itself.
//
// The calling thread's kernels run on the current stream. What is copied there waits for every kernel before it; on a stream
// beside it a batch comes while the update before is still computed. Three things make that safe, all of them PyTorch's:
// - the pinned memory is libtorch's, which does not give it out again before the copy was seen to end;
// - the current stream waits for the copy before whatever it is given from now on;
// - the copy's memory is told of the current stream, so that it is not given out again before that is done with it.
// Only what libtorch has for every kind of device is called, so that this takes no header of NVIDIA's.

#include <ATen/ATen.h>
#include <c10/core/Event.h>
#include <c10/core/StreamGuard.h>
#include <c10/core/impl/VirtualGuardImpl.h>

#include <algorithm>
#include <cstring>
#include <optional>

namespace {

// One of each thread that copies: its copies come one after another.
c10::Stream copies(c10::Device device) {
  thread_local std::optional<c10::Stream> stream;
  if (!stream || stream->device() != device) {
    stream = c10::impl::VirtualGuardImpl{device.type()}.getStreamFromGlobalPool(device);
  }
  return *stream;
}

at::Tensor* refuse(const char* why, char* message, size_t room) {
  const size_t length = std::min(std::strlen(why), room);
  std::memcpy(message, why, length);
  std::memset(message + length, 0, room - length);
  return nullptr;
}

}  // namespace

// A tensor on a card with this size and these bytes, which is the caller's; none, and why not, when the card refuses.
extern "C" at::Tensor* comic_upload(const void* bytes, const int64_t* size, size_t dimensions, int8_t kind, int64_t card,
                                    char* message, size_t room) {
  try {
    const c10::Device device{c10::DeviceType::CUDA, static_cast<c10::DeviceIndex>(card)};
    const auto type = static_cast<at::ScalarType>(kind);
    const at::Tensor pinned = at::empty(c10::IntArrayRef{size, dimensions}, at::TensorOptions{type}.pinned_memory(true));
    if (pinned.nbytes() > 0) {
      std::memcpy(pinned.mutable_data_ptr(), bytes, pinned.nbytes());
    }
    const c10::Stream computing = c10::impl::VirtualGuardImpl{device.type()}.getStream(device);
    const c10::Stream copying = copies(device);
    at::Tensor there;
    {
      const c10::StreamGuard guard{copying};
      there = pinned.to(device, type, /*non_blocking=*/true);
    }
    c10::Event arrived{device.type()};
    arrived.record(copying);
    arrived.block(computing);
    there.record_stream(computing);
    return new at::Tensor{std::move(there)};
  } catch (const std::exception& error) {
    return refuse(error.what(), message, room);
  } catch (...) {
    return refuse("an exception of no known kind", message, room);
  }
}
