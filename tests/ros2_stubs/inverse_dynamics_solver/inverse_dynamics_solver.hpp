// The methods that a plugin of inverse_dynamics_solver (https://github.com/unisa-acg/inverse-dynamics-solver) has.
#pragma once
#include <Eigen/Core>
#include <rclcpp/node_interfaces/node_parameters_interface.hpp>
#include <string>
namespace inverse_dynamics_solver
{
using Vector = Eigen::VectorXd;
struct InverseDynamicsSolver
{
  using Parameters = rclcpp::node_interfaces::NodeParametersInterface::ConstSharedPtr;
  virtual ~InverseDynamicsSolver() = default;
  virtual void initialize(Parameters parameters, const std::string & space = "", const std::string & robot = "") = 0;
  virtual Eigen::MatrixXd getInertiaMatrix(const Vector & q) const = 0;
  virtual Vector getCoriolisVector(const Vector & q, const Vector & qd) const = 0;
  virtual Vector getGravityVector(const Vector & q) const = 0;
  virtual Vector getFrictionVector(const Vector & qd) const = 0;
  virtual Vector getTorques(const Vector & q, const Vector & qd, const Vector & qdd) const = 0;
};
}  // namespace inverse_dynamics_solver
