// libtorch's fused Adam, which tch lacks: one pass over the memory of a parameter on a CPU, one kernel for all of them on a GPU.

#include <ATen/core/Tensor.h>
#include <ATen/ops/_fused_adam.h>
#include <c10/core/GradMode.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <exception>
#include <vector>

namespace {

std::vector<at::Tensor> list(at::Tensor* const* tensors, size_t count) {
  std::vector<at::Tensor> list;
  list.reserve(count);
  std::for_each(tensors, tensors + count, [&](const at::Tensor* tensor) { list.push_back(*tensor); });
  return list;
}

bool refuse(const char* why, char* message, size_t room) {
  const size_t length = std::min(std::strlen(why), room);
  std::memcpy(message, why, length);
  std::memset(message + length, 0, room - length);
  return false;
}

}  // namespace

// One step of `count` parameters, in place, unless `skipped` is 1. `steps` and `skipped` are float32 scalars on their device.
// If libtorch refuses, false and the reason in `message`.
extern "C" bool comic_fused_adam(size_t count, at::Tensor* const* parameters, at::Tensor* const* gradients,
                                 at::Tensor* const* first, at::Tensor* const* second, const at::Tensor* steps,
                                 const at::Tensor* skipped, double learning_rate, double beta1, double beta2,
                                 double epsilon, char* message, size_t room) {
  try {
    const at::NoGradGuard guard;
    const std::vector<at::Tensor> all_steps(count, *steps);
    const std::array changed{list(parameters, count), list(first, count), list(second, count)};
    at::_fused_adam_(changed[0], list(gradients, count), changed[1], changed[2], {}, all_steps, learning_rate, beta1,
                     beta2, /*weight_decay=*/0.0, epsilon, /*amsgrad=*/false, /*maximize=*/false, /*grad_scale=*/{},
                     *skipped);
    // libtorch counts the changes of a tensor, but not those of this function.
    for (const auto& tensors : changed) {
      for (const at::Tensor& tensor : tensors) tensor.unsafeGetTensorImpl()->bump_version();
    }
    return true;
  } catch (const std::exception& error) {
    return refuse(error.what(), message, room);
  } catch (...) {
    return refuse("an exception of another kind", message, room);
  }
}
