# For building on the PyPI wheels of ROS 2: the CMake exports of the *_rosidl_generator_py targets name include
# directories of the machine on which the wheels were built, and CMake refuses to generate with one that is missing.
# Given as CMAKE_PROJECT_INCLUDE, this drops such directories from every imported target once the project is read.

function(drop_missing_include_directories)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(directories ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT directories)
      continue()
    endif()
    set(present "")
    foreach(directory IN LISTS directories)
      if(directory MATCHES "^\\$<" OR EXISTS "${directory}")
        list(APPEND present "${directory}")
      endif()
    endforeach()
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${present}")
  endforeach()
endfunction()

cmake_language(DEFER CALL drop_missing_include_directories)
