// In place of a class loader: a function that makes the plugin of an interface.
#pragma once
template <typename Base>
Base * make_plugin();
#define PLUGINLIB_EXPORT_CLASS(type, base) \
  template <>                              \
  base * make_plugin<base>()               \
  {                                        \
    return new type();                     \
  }
