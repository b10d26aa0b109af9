// Reads the operators of a TorchScript module. tch can run a module, but it cannot show what the module consists of.
//
// The graph goes to Rust as JSON, and the constants that are tensors separately. Before that, libtorch's own passes make the
// graph simple: they replace operators that work in place, where that changes no result, and compute what depends on no input.

#include <ATen/core/ivalue.h>
#include <torch/csrc/jit/ir/constants.h>
#include <torch/csrc/jit/ir/ir.h>
#include <torch/csrc/jit/passes/constant_propagation.h>
#include <torch/csrc/jit/passes/dead_code_elimination.h>
#include <torch/csrc/jit/passes/inliner.h>
#include <torch/csrc/jit/passes/remove_mutation.h>
#include <torch/csrc/jit/serialization/import.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <iomanip>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <unordered_map>
#include <vector>

namespace {

using torch::jit::Node;
using torch::jit::Stack;
using torch::jit::Value;

using Values = std::unordered_map<const Value*, c10::IValue>;

struct Graph {
  std::string json;
  std::vector<at::Tensor> constants;
};

// Runs the graph node by node, and keeps every value.
Values run(const torch::jit::Graph& graph, const std::vector<at::Tensor>& inputs) {
  Values values;
  const auto parameters = graph.inputs();
  if (parameters.size() != inputs.size() + 1) {
    throw std::runtime_error("the module has " + std::to_string(parameters.size() - 1) + " inputs, but the description " +
                             std::to_string(inputs.size()));
  }
  for (size_t index = 0; index < inputs.size(); ++index) {
    values[parameters[index + 1]] = inputs[index];
  }
  for (const Node* node : graph.nodes()) {
    if (node->kind() == torch::jit::prim::Constant) {
      values[node->output()] = *torch::jit::toIValue(node->output());
      continue;
    }
    Stack stack;
    for (const Value* input : node->inputs()) {
      stack.push_back(values.at(input));
    }
    if (node->kind() == torch::jit::prim::ListConstruct) {
      c10::impl::GenericList list{node->output()->type()->expect<c10::ListType>()->getElementType()};
      for (c10::IValue& item : stack) {
        list.push_back(std::move(item));
      }
      stack = {list};
    } else if (node->kind() == torch::jit::prim::ListUnpack) {
      stack = stack.at(0).toListRef().vec();
    } else {
      node->getOperation()(stack);
    }
    // The trace had one row: a list of all rows would be longer now.
    if (stack.size() != node->outputs().size()) {
      throw std::runtime_error(std::string{"the number of results of "} + node->kind().toQualString() +
                               " depends on the number of rows");
    }
    for (size_t index = 0; index < stack.size(); ++index) {
      values[node->outputs()[index]] = stack[index];
    }
  }
  return values;
}

class Writer {
 public:
  Writer(const Values& few, const Values& more) : few_{few}, more_{more} {}

  Graph write(const torch::jit::Graph& graph) {
    out_ << R"({"inputs":)";
    list(graph.inputs().slice(1), [this](const Value* input) { value(input); });
    out_ << R"(,"nodes":)";
    std::vector<const Node*> nodes;
    for (const Node* node : graph.nodes()) {
      const auto kind = node->kind();
      // Constants and lists are written where they are used.
      if (kind != torch::jit::prim::Constant && kind != torch::jit::prim::ListConstruct &&
          kind != torch::jit::prim::ListUnpack) {
        nodes.push_back(node);
      }
    }
    list(nodes, [this](const Node* each) { node(each); });
    out_ << R"(,"outputs":)";
    list(graph.outputs(), [this](const Value* output) { argument(output); });
    out_ << "}";
    return {out_.str(), std::move(constants_)};
  }

 private:
  template <typename List, typename Write>
  void list(const List& items, Write write) {
    out_ << "[";
    bool first = true;
    for (const auto& item : items) {
      out_ << (first ? "" : ",");
      first = false;
      write(item);
    }
    out_ << "]";
  }

  void node(const Node* node) {
    const auto* schema = node->maybeSchema();
    if (schema == nullptr) {
      throw std::runtime_error(std::string{"the operator "} + node->kind().toQualString() + " has no schema");
    }
    const auto& overload = schema->overload_name();
    out_ << R"({"operator":")" << schema->name() << (overload.empty() ? "" : ".") << overload << R"(","arguments":{)";
    for (size_t index = 0; index < node->inputs().size(); ++index) {
      out_ << (index > 0 ? "," : "") << '"' << schema->arguments().at(index).name() << R"(":)";
      argument(node->inputs()[index]);
    }
    out_ << R"(},"outputs":)";
    list(results(node), [this](const Value* output) { value(output); });
    out_ << "}";
  }

  // The tensors that a node makes: of a list, those that it is unpacked to.
  static std::vector<const Value*> results(const Node* node) {
    std::vector<const Value*> found;
    for (const Value* output : node->outputs()) {
      if (output->type()->kind() != c10::TypeKind::ListType) {
        found.push_back(output);
        continue;
      }
      if (output->uses().size() != 1 || output->uses()[0].user->kind() != torch::jit::prim::ListUnpack) {
        throw std::runtime_error(std::string{"a list of "} + node->kind().toQualString() + " is not unpacked");
      }
      for (const Value* each : output->uses()[0].user->outputs()) {
        found.push_back(each);
      }
    }
    return found;
  }

  // A tensor: its number, type and sizes. A size that depends on the number of rows is null.
  void value(const Value* value) {
    const c10::IValue &one = few_.at(value), &other = more_.at(value);
    if (!one.isTensor()) {
      throw std::runtime_error("the value %" + value->debugName() + " is a number or a list that depends on an input");
    }
    const auto sizes = one.toTensor().sizes(), others = other.toTensor().sizes();
    if (sizes.size() != others.size()) {
      throw std::runtime_error("the rank of %" + value->debugName() + " depends on the number of rows");
    }
    out_ << R"({"id":)" << value->unique() << R"(,"kind":)" << static_cast<int>(one.toTensor().scalar_type());
    out_ << R"(,"sizes":)";
    std::vector<std::string> written;
    for (size_t index = 0; index < sizes.size(); ++index) {
      written.push_back(sizes[index] == others[index] ? std::to_string(sizes[index]) : "null");
    }
    list(written, [this](const std::string& size) { out_ << size; });
    out_ << "}";
  }

  void argument(const Value* value) {
    if (const auto known = torch::jit::toIValue(value)) {
      constant(*known);
    } else if (value->node()->kind() == torch::jit::prim::ListConstruct) {
      list(value->node()->inputs(), [this](const Value* each) { argument(each); });
    } else {
      this->value(value);
    }
  }

  void constant(const c10::IValue& known) {
    if (known.isTensor()) {
      out_ << R"({"constant":)" << constants_.size() << "}";
      constants_.push_back(known.toTensor().detach().contiguous());
    } else if (known.isBool()) {
      out_ << (known.toBool() ? "true" : "false");
    } else if (known.isInt()) {
      out_ << known.toInt();
    } else if (known.isDouble() && std::isfinite(known.toDouble())) {
      // In JSON, too, it is a number that is not an integer.
      std::ostringstream number;
      number << std::scientific << std::setprecision(std::numeric_limits<double>::max_digits10) << known.toDouble();
      out_ << number.str();
    } else if (known.isNone() || known.isDevice()) {
      // A file of ONNX names no device.
      out_ << "null";
    } else if (known.isList()) {
      list(known.toListRef(), [this](const c10::IValue& each) { constant(each); });
    } else {
      throw std::runtime_error("an argument is a constant of the kind " + known.tagKind());
    }
  }

  const Values &few_, &more_;
  std::ostringstream out_;
  std::vector<at::Tensor> constants_;
};

std::vector<at::Tensor> rows(const at::Tensor* const* inputs, size_t count, int64_t number) {
  std::vector<at::Tensor> found;
  for (size_t index = 0; index < count; ++index) {
    found.push_back(inputs[index]->expand({number, inputs[index]->size(1)}).contiguous());
  }
  return found;
}

Graph* refuse(const char* why, char* message, size_t room) {
  const size_t length = std::min(std::strlen(why), room);
  std::memcpy(message, why, length);
  std::memset(message + length, 0, room - length);
  return nullptr;
}

}  // namespace

// The graph of `forward` of the module in the file `path`. `inputs` are examples of its inputs, one row each. If libtorch fails,
// null and the reason in `message`.
extern "C" Graph* comic_graph_read(const char* path, const at::Tensor* const* inputs, size_t count, char* message,
                                   size_t room) {
  try {
    const c10::InferenceMode guard;
    auto graph = torch::jit::load(path, at::kCPU).get_method("forward").graph()->copy();
    torch::jit::Inline(*graph);
    torch::jit::RemoveTensorMutation(graph);
    torch::jit::ConstantPropagation(graph);
    torch::jit::EliminateDeadCode(graph);
    // Two numbers of rows, neither of them that of the trace: what is equal in both does not depend on it.
    const Values few = run(*graph, rows(inputs, count, 2)), more = run(*graph, rows(inputs, count, 3));
    return new Graph{Writer{few, more}.write(*graph)};
  } catch (const std::exception& error) {
    return refuse(error.what(), message, room);
  } catch (...) {
    return refuse("an exception of no known kind", message, room);
  }
}

// The graph as JSON, which lives as long as the graph.
extern "C" const char* comic_graph_json(const Graph* graph, size_t* length) noexcept {
  *length = graph->json.size();
  return graph->json.data();
}

extern "C" size_t comic_graph_constants(const Graph* graph) noexcept { return graph->constants.size(); }

// A constant, owned by the caller. `index` is less than the number of constants.
extern "C" at::Tensor* comic_graph_constant(const Graph* graph, size_t index) noexcept {
  return new at::Tensor{graph->constants[index]};
}

extern "C" void comic_graph_free(Graph* graph) noexcept { delete graph; }
