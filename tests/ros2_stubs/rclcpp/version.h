// The major version of Jazzy; -DRCLCPP_VERSION_MAJOR=16 gives the interfaces of Humble.
#pragma once
#ifndef RCLCPP_VERSION_MAJOR
#define RCLCPP_VERSION_MAJOR 28
#endif
