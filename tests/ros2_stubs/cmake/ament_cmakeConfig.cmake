# In place of ament: dependencies are the headers beside this folder.
function(ament_target_dependencies target)
  target_include_directories(${target} PRIVATE ${ament_cmake_DIR}/..)
endfunction()
function(ament_package)
  install(FILES package.xml DESTINATION share/${PROJECT_NAME})
endfunction()
