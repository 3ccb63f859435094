// Functions by which tests drive the exported controller in place of a controller manager.
#include <controller_interface/chainable_controller_interface.hpp>
#include <algorithm>
#include <cstdlib>
#include <new>

using Base = controller_interface::ChainableControllerInterface;
using controller_interface::CallbackReturn;
template <typename Interface>
Interface * make_plugin();
template <>
Base * make_plugin<Base>();

static long allocations = 0;

void * operator new(std::size_t size)
{
  ++allocations;
  if (void * memory = std::malloc(size ? size : 1)) {
    return memory;
  }
  throw std::bad_alloc();
}
void operator delete(void * memory) noexcept { std::free(memory); }
void operator delete(void * memory, std::size_t) noexcept { std::free(memory); }

struct Harness
{
  std::unique_ptr<Base> controller{make_plugin<Base>()};
#if RCLCPP_VERSION_MAJOR < 21
  std::vector<hardware_interface::CommandInterface> references;
#else
  std::vector<hardware_interface::CommandInterface::SharedPtr> references;
#endif
  std::string text;

  rclcpp_lifecycle::LifecycleNode & node() { return *controller->get_node(); }

  const char * set(const char * name, const rclcpp::ParameterValue & value)
  {
    const auto result = node().set(name, value);
    text = result.reason;
    return result.successful ? nullptr : text.c_str();
  }

  template <typename Message>
  std::vector<Message> & published(const char * topic)
  {
    return std::static_pointer_cast<rclcpp::Publisher<Message>>(node().publishers.at(topic))->published;
  }
};

static rclcpp::ParameterValue value_of(const double * numbers, int count)
{
  return rclcpp::ParameterValue(
    count < 0 ? rclcpp::Values(*numbers) : rclcpp::Values(std::vector<double>(numbers, numbers + count)));
}

extern "C" {
Harness * harness_new(const char * name)
{
  auto * harness = new Harness;
  harness->controller->make_node(name);
  return harness;
}
void harness_delete(Harness * harness) { delete harness; }

// Parameters of a file: count -1 is one number.
void harness_numbers(Harness * harness, const char * name, const double * numbers, int count)
{
  harness->node().overrides[name] = value_of(numbers, count);
}
void harness_text(Harness * harness, const char * name, const char * text)
{
  harness->node().overrides[name] = rclcpp::ParameterValue(rclcpp::Values(std::string(text)));
}
void harness_flag(Harness * harness, const char * name, int flag)
{
  harness->node().overrides[name] = rclcpp::ParameterValue(rclcpp::Values(flag != 0));
}

// Initialise, configure and activate. Return null, or the error.
const char * harness_start(Harness * harness)
{
  auto & controller = *harness->controller;
#if RCLCPP_VERSION_MAJOR < 21
  harness->node().declare_overrides();
#endif
  if (controller.on_init() != CallbackReturn::SUCCESS ||
      controller.on_configure({}) != CallbackReturn::SUCCESS) {
    return rclcpp::last_log().c_str();
  }
  harness->references = controller.export_reference_interfaces();
  controller.commands().resize(controller.command_interface_configuration().names.size());
  controller.states().resize(controller.state_interface_configuration().names.size());
  return controller.on_activate({}) == CallbackReturn::SUCCESS ? nullptr : rclcpp::last_log().c_str();
}

int harness_deactivate(Harness * harness, double * commands)
{
  const bool done = harness->controller->on_deactivate({}) == CallbackReturn::SUCCESS;
  for (const auto & interface : harness->controller->commands()) {
    *commands++ = interface.value;
  }
  return done;
}
int harness_activate(Harness * harness) { return harness->controller->on_activate({}) == CallbackReturn::SUCCESS; }

// Names of command, state and reference interfaces, one per line.
const char * harness_interfaces(Harness * harness)
{
  harness->text.clear();
  for (const auto & name : harness->controller->command_interface_configuration().names) {
    harness->text += name + "\n";
  }
  for (const auto & name : harness->controller->state_interface_configuration().names) {
    harness->text += name + "\n";
  }
  for (const auto & reference : harness->references) {
#if RCLCPP_VERSION_MAJOR < 21
    harness->text += reference.get_name() + "\n";
#else
    harness->text += reference->get_name() + "\n";
#endif
  }
  return harness->text.c_str();
}

// Run one cycle; commands are as written. Return the number of allocations, or -1 for an error.
long harness_update(
  Harness * harness, double time, double period, const double * states, int available, double * commands)
{
  auto & controller = *harness->controller;
  for (auto & interface : controller.states()) {
    interface.value = *states++;
    interface.available = available != 0;
  }
  const long before = allocations;
  const auto result =
    controller.update(rclcpp::Time(static_cast<int64_t>(time * 1e9)), rclcpp::Duration(period));
  const long during = allocations - before;
  for (const auto & interface : controller.commands()) {
    *commands++ = interface.value;
  }
  return result == controller_interface::return_type::OK ? during : -1;
}

void harness_reference(
  Harness * harness, const double * q, int nq, const double * qd, int nqd, const double * qdd, int nqdd)
{
  auto message = std::make_shared<trajectory_msgs::msg::JointTrajectoryPoint>();
  message->positions.assign(q, q + nq);
  message->velocities.assign(qd, qd + nqd);
  message->accelerations.assign(qdd, qdd + nqdd);
  std::static_pointer_cast<rclcpp::Subscription<trajectory_msgs::msg::JointTrajectoryPoint>>(
    harness->node().subscriptions.at("~/reference"))
    ->callback(message);
}
void harness_chain(Harness * harness, int chained) { harness->controller->set_chained_mode(chained != 0); }
void harness_write(Harness * harness, int index, double value)
{
#if RCLCPP_VERSION_MAJOR < 21
  harness->references.at(index).set_value(value);
#else
  static_cast<void>(harness->references.at(index)->set_value(value));
#endif
}

// Return null, or why the parameter was refused.
const char * harness_set(Harness * harness, const char * name, const double * numbers, int count)
{
  return harness->set(name, value_of(numbers, count));
}
const char * harness_set_text(Harness * harness, const char * name, const char * text)
{
  return harness->set(name, rclcpp::ParameterValue(rclcpp::Values(std::string(text))));
}
const char * harness_set_flag(Harness * harness, const char * name, int flag)
{
  return harness->set(name, rclcpp::ParameterValue(rclcpp::Values(flag != 0)));
}

// Name, lower and upper limit of each numeric parameter, one per line.
const char * harness_ranges(Harness * harness)
{
  harness->text.clear();
  for (const auto & [name, descriptor] : harness->node().descriptors) {
    for (const auto & range : descriptor.floating_point_range) {
      harness->text += name + " " + std::to_string(range.from_value) + " " + std::to_string(range.to_value) + " " +
                       descriptor.description + "\n";
    }
  }
  return harness->text.c_str();
}

// Names of all parameters, one per line.
const char * harness_parameters(Harness * harness)
{
  harness->text.clear();
  for (const auto & item : harness->node().descriptors) {
    harness->text += item.first + "\n";
  }
  return harness->text.c_str();
}

// Run the timer of the publishers; return the last state.
const char * harness_state(Harness * harness)
{
  harness->node().timer->callback();
  auto & states = harness->published<std_msgs::msg::String>("~/state");
  harness->text = states.empty() ? "" : states.back().data;
  return harness->text.c_str();
}

// The efforts of the last joint state of a topic; return its joints, one per line.
const char * harness_joint_state(Harness * harness, const char * topic, double * efforts)
{
  const auto & message = harness->published<sensor_msgs::msg::JointState>(topic).back();
  harness->text.clear();
  for (const auto & name : message.name) {
    harness->text += name + "\n";
  }
  std::copy(message.effort.begin(), message.effort.end(), efforts);
  return harness->text.c_str();
}

// Force and torque of the last wrench; return its frame.
const char * harness_wrench(Harness * harness, double * values)
{
  const auto & message = harness->published<geometry_msgs::msg::WrenchStamped>("~/tip_wrench").back();
  const auto & wrench = message.wrench;
  for (const auto & vector : {wrench.force, wrench.torque}) {
    for (double value : {vector.x, vector.y, vector.z}) {
      *values++ = value;
    }
  }
  harness->text = message.header.frame_id;
  return harness->text.c_str();
}

// Mass, centre of mass, inertia and the interval of the mass of the last payload; return its frame, or null.
const char * harness_payload(Harness * harness, double * values)
{
  const auto & messages = harness->published<geometry_msgs::msg::InertiaStamped>("~/payload");
  if (messages.empty()) {
    return nullptr;
  }
  const auto & inertia = messages.back().inertia;
  const auto & interval = harness->published<std_msgs::msg::Float64MultiArray>("~/payload_mass_interval").back().data;
  for (double value :
    {inertia.m, inertia.com.x, inertia.com.y, inertia.com.z, inertia.ixx, inertia.ixy, inertia.ixz, inertia.iyy,
      inertia.iyz, inertia.izz, interval.at(0), interval.at(1)}) {
    *values++ = value;
  }
  harness->text = messages.back().header.frame_id;
  return harness->text.c_str();
}
const char * harness_log(Harness *) { return rclcpp::last_log().c_str(); }
}
