// In place of hardware_interface: named numbers, with the methods of Jazzy, or of Humble.
#pragma once
#include <limits>
#include <memory>
#include <optional>
#include <rclcpp/version.h>
#include <string>

namespace hardware_interface
{
#if RCLCPP_VERSION_MAJOR < 21
class CommandInterface
{
public:
  CommandInterface(const std::string & prefix, const std::string & name, double * value)
  : name_(prefix + "/" + name), value_(value)
  {
  }
  const std::string & get_name() const { return name_; }
  double get_value() const { return *value_; }
  void set_value(double value) { *value_ = value; }

private:
  std::string name_;
  double * value_;
};
#else
struct InterfaceInfo
{
  std::string name, data_type;
};

struct InterfaceDescription
{
  InterfaceDescription(const std::string & prefix, const InterfaceInfo & info) : name(prefix + "/" + info.name) {}
  std::string name;
};

class CommandInterface
{
public:
  using SharedPtr = std::shared_ptr<CommandInterface>;
  explicit CommandInterface(const InterfaceDescription & description) : name_(description.name) {}
  const std::string & get_name() const { return name_; }
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional() const
  {
    return value_;
  }
  template <typename T>
  [[nodiscard]] bool set_value(const T & value)
  {
    value_ = value;
    return true;
  }

private:
  std::string name_;
  double value_ = std::numeric_limits<double>::quiet_NaN();
};
#endif

// Interfaces of the hardware; available: false as if another thread used it.
class LoanedInterface
{
public:
  double value = std::numeric_limits<double>::quiet_NaN();
  bool available = true;
#if RCLCPP_VERSION_MAJOR < 21
  double get_value() const { return value; }
  void set_value(double written) { value = written; }
#else
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional(unsigned int = 10) const
  {
    return available ? std::optional<T>(value) : std::nullopt;
  }
  template <typename T>
  [[nodiscard]] bool set_value(const T & written, unsigned int = 10)
  {
    value = available ? written : value;
    return available;
  }
#endif
};
using LoanedCommandInterface = LoanedInterface;
using LoanedStateInterface = LoanedInterface;
}  // namespace hardware_interface
