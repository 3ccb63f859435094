// In place of controller_interface: the methods that a chainable controller implements, in Jazzy or Humble.
#pragma once
#include <hardware_interface/handle.hpp>
#include <rclcpp/rclcpp.hpp>
#include <string>
#include <vector>

namespace controller_interface
{
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class return_type : std::uint8_t { OK = 0, ERROR = 1 };
enum class interface_configuration_type : std::uint8_t { ALL = 0, INDIVIDUAL = 1, NONE = 2 };

struct InterfaceConfiguration
{
  interface_configuration_type type = interface_configuration_type::NONE;
  std::vector<std::string> names = {};
};

class ChainableControllerInterface
{
public:
  virtual ~ChainableControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;

  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() { return node_; }
  std::shared_ptr<const rclcpp_lifecycle::LifecycleNode> get_node() const { return node_; }
  bool is_in_chained_mode() const { return chained_; }
  bool set_chained_mode(bool chained)
  {
    chained_ = chained;
    return on_set_chained_mode(chained);
  }

#if RCLCPP_VERSION_MAJOR < 21
  auto export_reference_interfaces() { return on_export_reference_interfaces(); }
  return_type update(const rclcpp::Time & time, const rclcpp::Duration & period)
  {
    if (!chained_ && update_reference_from_subscribers() != return_type::OK) {
      return return_type::ERROR;
    }
    return update_and_write_commands(time, period);
  }
#else
  auto export_reference_interfaces() { return on_export_reference_interfaces_list(); }
  return_type update(const rclcpp::Time & time, const rclcpp::Duration & period)
  {
    if (!chained_ && update_reference_from_subscribers(time, period) != return_type::OK) {
      return return_type::ERROR;
    }
    return update_and_write_commands(time, period);
  }
#endif

  // for tests, in place of a controller manager
  void make_node(const std::string & name) { node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>(name); }
  std::vector<hardware_interface::LoanedCommandInterface> & commands() { return command_interfaces_; }
  std::vector<hardware_interface::LoanedStateInterface> & states() { return state_interfaces_; }

protected:
  virtual bool on_set_chained_mode(bool chained) = 0;
#if RCLCPP_VERSION_MAJOR < 21
  virtual std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() = 0;
  virtual return_type update_reference_from_subscribers() = 0;
#else
  virtual std::vector<hardware_interface::CommandInterface::SharedPtr> on_export_reference_interfaces_list() = 0;
  virtual return_type update_reference_from_subscribers(const rclcpp::Time & time, const rclcpp::Duration & period) = 0;
#endif
  virtual return_type update_and_write_commands(const rclcpp::Time & time, const rclcpp::Duration & period) = 0;

  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;
  std::vector<double> reference_interfaces_;

private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_;
  bool chained_ = false;
};
}  // namespace controller_interface
