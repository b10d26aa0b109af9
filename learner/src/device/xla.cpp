// XLA's place in libtorch's table of devices, for callers that do not know it by name.
//
// tch numbers devices as CPU, CUDA, MPS and Vulkan, and tells a tensor on any other device to be on MPS. MPS is Apple's,
// and no libtorch for Linux has it, so here the name is free: a new tensor asked for on MPS is made on XLA, and one on XLA
// says that it is on MPS. Every other operation is dispatched by the tensors it gets, so these two factories are all there
// is to it.

#include <ATen/ATen.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/library.h>

#include <cstdlib>

namespace {

// As the learner left it, before the first tensor.
int index() {
  const char* text = std::getenv("COMIC_XLA_INDEX");
  return text == nullptr ? 0 : std::atoi(text);
}

// Which of several: torch_xla's own choice is one of each thread, and this one is the process's.
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
