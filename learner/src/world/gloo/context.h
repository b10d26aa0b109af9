// Wheels of PyTorch contain gloo, but not its headers, which c10d's header of `ProcessGroupGloo` includes. This file and the others of
// this directory declare what that header names. Nothing here is defined or called by us, and c10d holds all of it behind pointers, so
// the memory layout of gloo's classes does not matter.

#pragma once

#include <chrono>

namespace gloo {

class Context {
 public:
  void setTimeout(std::chrono::milliseconds timeout);
};

}  // namespace gloo
