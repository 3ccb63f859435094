// The messages that the exported controller uses, with the members of the ROS 2 packages.
#pragma once
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

namespace builtin_interfaces::msg
{
struct Time
{
  int32_t sec = 0;
  uint32_t nanosec = 0;
};
}  // namespace builtin_interfaces::msg

namespace std_msgs::msg
{
struct Header
{
  builtin_interfaces::msg::Time stamp;
  std::string frame_id;
};
struct String
{
  std::string data;
};
struct Float64MultiArray
{
  std::vector<double> data;
};
}  // namespace std_msgs::msg

namespace sensor_msgs::msg
{
struct JointState
{
  std_msgs::msg::Header header;
  std::vector<std::string> name;
  std::vector<double> position, velocity, effort;
};
}  // namespace sensor_msgs::msg

namespace trajectory_msgs::msg
{
struct JointTrajectoryPoint
{
  using SharedPtr = std::shared_ptr<JointTrajectoryPoint>;
  std::vector<double> positions, velocities, accelerations, effort;
};
}  // namespace trajectory_msgs::msg

namespace geometry_msgs::msg
{
struct Vector3
{
  double x = 0.0, y = 0.0, z = 0.0;
};
struct Wrench
{
  Vector3 force, torque;
};
struct WrenchStamped
{
  std_msgs::msg::Header header;
  Wrench wrench;
};
struct Inertia
{
  double m = 0.0;
  Vector3 com;
  double ixx = 0.0, ixy = 0.0, ixz = 0.0, iyy = 0.0, iyz = 0.0, izz = 0.0;
};
struct InertiaStamped
{
  std_msgs::msg::Header header;
  Inertia inertia;
};
}  // namespace geometry_msgs::msg

namespace rcl_interfaces::msg
{
struct FloatingPointRange
{
  double from_value = 0.0, to_value = 0.0, step = 0.0;
};
struct ParameterDescriptor
{
  std::string name, description;
  bool read_only = false;
  std::vector<FloatingPointRange> floating_point_range;
};
struct SetParametersResult
{
  bool successful = false;
  std::string reason;
};
}  // namespace rcl_interfaces::msg
