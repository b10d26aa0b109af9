// Registers XLA in libtorch's table of devices, for callers that have no name for it.
//
// tch numbers devices as CPU, CUDA, MPS and Vulkan, and reports a tensor on any other device as MPS. MPS belongs to Apple,
// and no libtorch for Linux has it, so the name is free here. A new tensor on MPS is made on XLA, and a tensor on XLA reports
// MPS. Every other operation is dispatched by its tensors, so these two factories are enough.

#include <ATen/ATen.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/library.h>

#include <cstdlib>

namespace {

// Set by the learner before the first tensor.
int index() {
  const char* text = std::getenv("COMIC_XLA_INDEX");
  return text == nullptr ? 0 : std::atoi(text);
}

// The device's number for the whole process: torch_xla itself has one for each thread.
at::Device xla() {
  static const at::Device device{at::kXLA, static_cast<c10::DeviceIndex>(index())};
  return device;
}

at::Tensor empty(c10::SymIntArrayRef size, std::optional<at::ScalarType> dtype, std::optional<at::Layout> layout,
                 std::optional<at::Device>, std::optional<bool> pin_memory,
                 std::optional<at::MemoryFormat> memory_format) {
  return at::empty_symint(size, dtype, layout, xla(), pin_memory, memory_format);
}

at::Tensor empty_strided(c10::SymIntArrayRef size, c10::SymIntArrayRef stride, std::optional<at::ScalarType> dtype,
                         std::optional<at::Layout> layout, std::optional<at::Device>, std::optional<bool> pin_memory) {
  return at::empty_strided_symint(size, stride, dtype, layout, xla(), pin_memory);
}

C10_REGISTER_GUARD_IMPL(MPS, c10::impl::NoOpDeviceGuardImpl<c10::DeviceType::MPS>)

TORCH_LIBRARY_IMPL(aten, MPS, library) {
  library.impl("empty.memory_format", empty);
  library.impl("empty_strided", empty_strided);
}

}  // namespace
