# In place of pluginlib: the description is installed where plugins of a package's base class are looked for.
function(pluginlib_export_plugin_description_file base description)
  install(FILES ${description} DESTINATION share/${base}/plugins)
endfunction()
