# SPDX-License-Identifier: Apache-2.0
from pipeprog_camera.files.user_folders import provide_user_folders

provide_user_folders()  # before a function is compiled
