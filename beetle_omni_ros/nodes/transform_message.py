"""
The message class of `/tf`, also for ROS from PyPI, which has no tf2_msgs.

The wheels contain the generators that make a message package from its definition. The package is
compiled once and kept in the cache of the compiled controllers.
"""

from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
import hashlib
from importlib import import_module
import json
import logging
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
import tempfile

from beetle_omni_ros.robot.native import cache_folder, CompilerError

log = logging.getLogger(__name__)

DEFINITION = """#include "geometry_msgs/msg/TransformStamped.idl"
module tf2_msgs { module msg { struct TFMessage {
  sequence<geometry_msgs::msg::TransformStamped> transforms;
}; }; };
"""
# Both kinds of type support in one library, which rclpy looks up by name.
DISPATCH = """#include <string.h>
#include "rosidl_runtime_c/message_type_support_struct.h"
#include "tf2_msgs/msg/detail/tf_message__functions.h"
#define HANDLE(kind) kind##__get_message_type_support_handle__tf2_msgs__msg__TFMessage
typedef rosidl_message_type_support_t Support;
const Support * HANDLE(rosidl_typesupport_fastrtps_c)(void);
const Support * HANDLE(rosidl_typesupport_introspection_c)(void);
static const Support * find(const Support * handle, const char * identifier)
{
  const Support * known[] = {handle, HANDLE(rosidl_typesupport_fastrtps_c)(),
    HANDLE(rosidl_typesupport_introspection_c)()};
  for (int k = 0; k < 3; k++) {
    if (!strcmp(known[k]->typesupport_identifier, identifier)) return known[k];
  }
  return 0;
}
const Support * HANDLE(rosidl_typesupport_c)(void)
{
  static Support handle = {"rosidl_typesupport_c", 0, find,
    tf2_msgs__msg__TFMessage__get_type_hash, tf2_msgs__msg__TFMessage__get_type_description,
    tf2_msgs__msg__TFMessage__get_type_description_sources};
  return &handle;
}
"""
# Generators in order: package, function, further arguments.
GENERATORS = (('rosidl_generator_type_description', 'generate_type_hash'),
              ('rosidl_generator_c', 'generate_c'),
              ('rosidl_typesupport_fastrtps_c', 'generate_typesupport_fastrtps_c'),
              ('rosidl_typesupport_introspection_c', 'generate_c'),
              ('rosidl_generator_py', 'generate_py', ['rosidl_typesupport_c']))
VISIBLE = ('rosidl_generator_c', 'rosidl_typesupport_fastrtps_c',
           'rosidl_typesupport_introspection_c')
DEPENDENCIES = ('geometry_msgs', 'std_msgs', 'builtin_interfaces')
LIBRARIES = ('geometry_msgs__rosidl_generator_c', 'geometry_msgs__rosidl_generator_py',
             'geometry_msgs__rosidl_typesupport_fastrtps_c',
             'geometry_msgs__rosidl_typesupport_introspection_c', 'rosidl_runtime_c',
             'rosidl_typesupport_c', 'rosidl_typesupport_fastrtps_c',
             'rosidl_typesupport_fastrtps_cpp', 'rosidl_typesupport_introspection_c', 'fastcdr')


def transform_message() -> type | None:
    """Return the class `tf2_msgs/msg/TFMessage`, built if it is missing; None if that fails."""
    try:
        return import_module('tf2_msgs.msg').TFMessage
    except ImportError:
        pass
    try:
        sys.path.append(str(built()))
        return import_module('tf2_msgs.msg').TFMessage
    except (CompilerError, ImportError) as error:
        log.warning('no tf2_msgs, so no /tf: %s', error)
        return None


def built() -> Path:
    """
    Build the package in the cache, unless it is there.

    Returns:
        The folder to import it from.

    Raises:
        CompilerError: missing compiler or generators, or one of them fails.

    """
    from rclpy import __file__ as rclpy
    key = '\n'.join((DEFINITION, DISPATCH, rclpy, sys.version, _version()))
    folder = cache_folder() / f'tf2_msgs_{hashlib.sha256(key.encode()).hexdigest()[:20]}'
    if not folder.is_dir():
        log.info('making tf2_msgs (once for this ROS)')
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent) as build:
                package = Path(build) / 'made' / 'tf2_msgs'
                _generate(package)
                _compile(package)
                os.replace(package.parent, folder)      # atomic: others may build it meanwhile
        except (OSError, ImportError, subprocess.SubprocessError) as error:
            if not folder.is_dir():
                raise CompilerError(f'tf2_msgs cannot be made ({error})') from None
    return folder


def _version():
    from importlib.metadata import PackageNotFoundError, version
    try:
        return version('ros-geometry-msgs')
    except PackageNotFoundError:
        return ''


def _generate(package):
    """Write C, C++ and Python sources of the message."""
    share = Path(sys.prefix) / 'share'
    (package / 'msg').mkdir(parents=True)
    (package / '__init__.py').touch()
    (package / 'msg' / 'TFMessage.idl').write_text(DEFINITION)
    (package / 'msg' / 'dispatch.c').write_text(DISPATCH)
    arguments = package / 'arguments.json'
    for generator, function, *rest in GENERATORS:
        arguments.write_text(json.dumps({
            'package_name': 'tf2_msgs', 'output_dir': str(package),
            'template_dir': str(share / generator / 'resource'),
            'idl_tuples': [f'{package}:msg/TFMessage.idl'],
            'type_description_tuples': [f'msg/TFMessage.idl:{package}/msg/TFMessage.json'],
            'include_paths': [f'{name}:{share / name}' for name in DEPENDENCIES],
            'ros_interface_dependencies': [], 'target_dependencies': []}))
        with redirect_stdout(sys.stderr):
            getattr(import_module(generator), function)(str(arguments), *rest)
    make_visible = import_module('rosidl_cli.command.helpers').generate_visibility_control_file
    for generator in VISIBLE:
        name = f'{generator}__visibility_control.h'
        make_visible(
            package_name='tf2_msgs', template_path=share / generator / 'resource' / f'{name}.in',
            output_path=package / 'msg' / name)


def _compile(package):
    """Compile all sources into one extension module."""
    import numpy as np
    prefix = Path(sys.prefix)
    include = [prefix / 'include', *(prefix / 'include').iterdir(), package.parent,
               Path(sysconfig.get_paths()['include']), Path(np.get_include())]
    flags = ['-O1', '-fPIC', '-w', *(f'-I{folder}' for folder in include if folder.is_dir())]
    compilers = {'.c': os.environ.get('CC', 'gcc'), '.cpp': os.environ.get('CXX', 'g++')}
    for compiler in compilers.values():
        if not shutil.which(compiler.split()[0]):
            raise CompilerError(f'no compiler {compiler}')
    sources = [path for path in package.rglob('*') if path.suffix in compilers]

    def one(source):
        output = source.with_suffix('.o' if source.suffix == '.c' else '.cpp.o')
        _run([*compilers[source.suffix].split(), *flags, '-c', str(source), '-o', str(output)])
        return str(output)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = list(pool.map(one, sources))
    _run([*compilers['.cpp'].split(), '-shared', '-o',
          str(package / 'tf2_msgs_s__rosidl_typesupport_c.so'), *objects,
          *(str(prefix / 'lib' / f'lib{name}.so') for name in LIBRARIES)])


def _run(command):
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ['no message']
        raise CompilerError(f'{command[0]} failed: {lines[0]}')
