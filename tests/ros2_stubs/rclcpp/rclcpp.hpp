// In place of rclcpp and rclcpp_lifecycle: the classes that the exported controller uses, without communication. A test
// sets parameters, calls subscriptions and timers, and reads published messages.
#pragma once
#include <chrono>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

#include "messages.hpp"

namespace rclcpp
{
class Time
{
public:
  explicit Time(int64_t nanoseconds) : nanoseconds_(nanoseconds) {}
  int64_t nanoseconds() const { return nanoseconds_; }
  operator builtin_interfaces::msg::Time() const
  {
    return {static_cast<int32_t>(nanoseconds_ / 1000000000), static_cast<uint32_t>(nanoseconds_ % 1000000000)};
  }

private:
  int64_t nanoseconds_;
};

class Duration
{
public:
  explicit Duration(double seconds) : seconds_(seconds) {}
  double seconds() const { return seconds_; }

private:
  double seconds_;
};

using Values = std::variant<std::monostate, bool, int64_t, double, std::string, std::vector<double>>;

struct ParameterValue
{
  Values values;
  explicit ParameterValue(Values values_in = {}) : values(std::move(values_in)) {}
};

class Parameter
{
public:
  Parameter(const std::string & name, const ParameterValue & value) : name_(name), value_(value) {}
  const std::string & get_name() const { return name_; }
  bool as_bool() const { return as<bool>(); }
  double as_double() const { return as<double>(); }
  std::string as_string() const { return as<std::string>(); }
  std::vector<double> as_double_array() const { return as<std::vector<double>>(); }
  const ParameterValue & get_parameter_value() const { return value_; }

private:
  std::string name_;
  ParameterValue value_;

  template <typename T>
  T as() const
  {
    if (!std::holds_alternative<T>(value_.values)) {
      throw std::runtime_error("expected another type of parameter " + name_);
    }
    return std::get<T>(value_.values);
  }
};

struct Logger
{
};

inline std::string & last_log()
{
  static std::string text;
  return text;
}

inline void log(const char * format, ...)
{
  char text[1000];
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(text, sizeof text, format, arguments);
  va_end(arguments);
  last_log() = text;
}

#define RCLCPP_ERROR(logger, ...) (static_cast<void>(logger), rclcpp::log(__VA_ARGS__))
#define RCLCPP_WARN(logger, ...) (static_cast<void>(logger), rclcpp::log(__VA_ARGS__))

struct SystemDefaultsQoS
{
};

template <typename Message>
struct Publisher
{
  using SharedPtr = std::shared_ptr<Publisher>;
  std::vector<Message> published;
  void publish(const Message & message) { published.push_back(message); }
};

template <typename Message>
struct Subscription
{
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(const typename Message::SharedPtr)> callback;
};

struct TimerBase
{
  using SharedPtr = std::shared_ptr<TimerBase>;
  std::function<void()> callback;
};

namespace node_interfaces
{
struct OnSetParametersCallbackHandle
{
  using SharedPtr = std::shared_ptr<OnSetParametersCallbackHandle>;
  std::function<rcl_interfaces::msg::SetParametersResult(const std::vector<Parameter> &)> callback;
};
}  // namespace node_interfaces
}  // namespace rclcpp

namespace rclcpp_lifecycle
{
struct State
{
};

class LifecycleNode
{
public:
  explicit LifecycleNode(const std::string & name) : name_(name) {}
  const char * get_name() const { return name_.c_str(); }
  rclcpp::Logger get_logger() const { return {}; }

  auto add_on_set_parameters_callback(
    std::function<rcl_interfaces::msg::SetParametersResult(const std::vector<rclcpp::Parameter> &)> callback)
  {
    auto handle = std::make_shared<rclcpp::node_interfaces::OnSetParametersCallbackHandle>();
    handle->callback = std::move(callback);
    on_set_ = handle;
    return handle;
  }

  bool has_parameter(const std::string & name) const { return parameters_.count(name); }
  rclcpp::Parameter get_parameter(const std::string & name) const { return {name, parameters_.at(name)}; }

  // As rclcpp: the value of a file replaces the default and must have its type; ranges are tested for one number only,
  // and NaN passes; then the callback decides.
  const rclcpp::ParameterValue & declare_parameter(
    const std::string & name, const rclcpp::ParameterValue & value,
    const rcl_interfaces::msg::ParameterDescriptor & descriptor)
  {
    descriptors[name] = descriptor;
    parameters_[name] = value;
    const auto result = set(name, overrides.count(name) ? overrides.at(name) : value);
    if (!result.successful) {
      throw std::invalid_argument("parameter '" + name + "' could not be set: " + result.reason);
    }
    return parameters_.at(name);
  }

  rcl_interfaces::msg::SetParametersResult set(const std::string & name, const rclcpp::ParameterValue & value)
  {
    const auto & descriptor = descriptors[name];
    if (value.values.index() != parameters_.at(name).values.index()) {
      return {false, "Wrong parameter type, parameter {" + name + "}"};
    }
    const double * number = std::get_if<double>(&value.values);
    if (number && !descriptor.floating_point_range.empty()) {
      const auto & range = descriptor.floating_point_range[0];
      if (*number < range.from_value || *number > range.to_value) {
        return {false, "Parameter {" + name + "} doesn't comply with floating point range."};
      }
    }
    const auto handle = on_set_.lock();
    const auto result = handle ? handle->callback({rclcpp::Parameter(name, value)})
                               : rcl_interfaces::msg::SetParametersResult{true, ""};
    if (result.successful) {
      parameters_[name] = value;
    }
    return result;
  }

  template <typename Message>
  auto create_publisher(const std::string & topic, const rclcpp::SystemDefaultsQoS &)
  {
    auto publisher = std::make_shared<rclcpp::Publisher<Message>>();
    publishers[topic] = publisher;
    return publisher;
  }

  template <typename Message>
  auto create_subscription(
    const std::string & topic, const rclcpp::SystemDefaultsQoS &,
    std::function<void(const typename Message::SharedPtr)> callback)
  {
    auto subscription = std::make_shared<rclcpp::Subscription<Message>>();
    subscription->callback = std::move(callback);
    subscriptions[topic] = subscription;
    return subscription;
  }

  auto create_wall_timer(std::chrono::nanoseconds, std::function<void()> callback)
  {
    timer = std::make_shared<rclcpp::TimerBase>();
    timer->callback = std::move(callback);
    return timer;
  }

  // for tests
  std::map<std::string, rclcpp::ParameterValue> overrides;
  std::map<std::string, rcl_interfaces::msg::ParameterDescriptor> descriptors;
  std::map<std::string, std::shared_ptr<void>> publishers, subscriptions;
  rclcpp::TimerBase::SharedPtr timer;

  // as Humble declares the parameters of a file before a controller does
  void declare_overrides() { parameters_ = overrides; }

private:
  std::string name_;
  std::map<std::string, rclcpp::ParameterValue> parameters_;
  std::weak_ptr<rclcpp::node_interfaces::OnSetParametersCallbackHandle> on_set_;
};
}  // namespace rclcpp_lifecycle
