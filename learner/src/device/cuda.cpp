// Copies to a GPU on a separate stream: tch has neither streams nor pinned memory, which a GPU can read by itself.
//
// The calling thread's kernels run on the current stream, where a copy would wait for every kernel before it. On a separate
// stream a batch is copied while the update before it is still computed. PyTorch makes that safe in three ways:
// - libtorch owns the pinned memory, and does not reuse it before the copy has ended;
// - the current stream waits for the copy before any later work;
// - the copy's memory is recorded on the current stream, so it is not reused before that stream has finished with it.
// Only functions that libtorch has for every kind of device are called, so this needs no header of NVIDIA's.

#include <ATen/ATen.h>
#include <c10/core/Event.h>
#include <c10/core/StreamGuard.h>
#include <c10/core/impl/VirtualGuardImpl.h>

#include <algorithm>
#include <cstring>
#include <optional>

namespace {

// One for each thread that copies, so that its copies run one after another.
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

// A tensor on a GPU with this size and these bytes, owned by the caller. If the GPU refuses, null and the reason in `message`.
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
