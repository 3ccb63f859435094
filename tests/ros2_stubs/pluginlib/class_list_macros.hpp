// In place of a class loader: a function that makes the one plugin.
#pragma once
#define PLUGINLIB_EXPORT_CLASS(type, base) \
  base * make_plugin();                    \
  base * make_plugin() { return new type(); }
