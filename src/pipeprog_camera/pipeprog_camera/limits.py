# SPDX-License-Identifier: Apache-2.0
"""Limits on what comes from outside, each with its reason: a size that is declared is compared before it is believed.

They bound memory and time, and leave every real recording, file and message through.
"""

from __future__ import annotations

# Images.
MAX_PIXELS = 1 << 26  # px; 67 megapixels, twice the largest video (8K: 33), decoded 200 MB
MIN_SIDE = 32  # px; below, not one window of the tracker fits between the borders of an image
MAX_ENCODED_IMAGE = 1 << 28  # bytes; four for each pixel at MAX_PIXELS: raw frames with an alpha channel
MAX_JPEG_SCANS = 100  # progressive JPEGs have about 10; the decoder passes over the whole image once a scan

# Cameras; lengths relative to the longer side of the image, so that they hold at every resolution.
MIN_FOCAL = 0.1  # of the longer side; a circular fisheye of 220 degrees, its circle 0.4 of the sensor's width, has 0.1
MAX_FOCAL = 100.0  # of the longer side; a field of view of 0.6 degrees, beyond the longest zoom lens of a robot (2)
MAX_PIXEL_ASPECT = 4.0  # fx / fy or its inverse; 2 for the fields of interlaced video and for anamorphic lenses
MAX_OFF_CENTRE = 1.0  # image sizes from the border to a principal point outside: a corner cut out of a larger image
MAX_CORNER_SHIFT = 1.0  # diagonals by which distortion moves a corner; the strongest barrel lenses stay below 0.5
MAX_DISTORTION_COEFFICIENTS = 14  # of rational_polynomial, the longest model
MAX_READOUT = 0.1  # s from the first row to the last; phones take 0.004 to 0.035, the slowest drones 0.074
MAX_ACCELERATION = 1e5  # m/s^2 and rad/s^2 of a camera, a hundred times what a fall on concrete makes
MAX_VELOCITY = 1000.0  # m/s and rad/s of a camera; a drone flies at 20 and turns at 5

# Clouds and trajectories.
MAX_CLOUD_POINTS = 1 << 26  # points; 67 million: a building at 5 mm; 1.6 GB as coordinates in double precision
MAX_CLOUD_FIELDS = 256  # of a point; LAS has at most 40, descriptors of PCL are one field of several values
MAX_POINT_STEP = 1 << 16  # bytes of a point; the longest descriptors of PCL have 8 kB, NumPy ends at 2^31
MAX_NORMAL_ERROR = 0.01  # of a normal's length from 1; halves of single precision, as some writers store, keep 0.001
MAX_POSES = 100_000  # keyframes; 14 hours at two a second
MAX_OVERLAP = 1.001  # share of an image; areas of nearly equal hulls round to more than 1 in 32 bits
MAX_COORDINATE = 1e8  # m; beyond the coordinates of any map projection (UTM: 1e7)

# Files of clouds.
MAX_CLOUD_POINTS_PER_BYTE = 8  # a bit a point: half a millimetre of noise alone takes 2 bits of each coordinate
MAX_CLOUD_RECORDS = 1 << 31  # bytes that are unpacked at once; 32 for each point at MAX_CLOUD_POINTS
MAX_CLOUD_CHUNKS = 1 << 15  # of a LAZ file, half a millisecond each; 2048 points each at MAX_CLOUD_POINTS
MAX_COMPRESSED_POINT = 2048  # bytes of a LAZ point; lazrs keeps 10 kB for each byte, once a processor
MAX_CLOUD_HEADER = 1 << 16  # bytes; the headers of PLY and PCD have a line for each column and a few comments
MAX_CLOUD_LINE = 1 << 16  # characters of a point in text; 1000 columns of a table
MAX_CLOUD_DESCRIPTION = 1 << 26  # bytes of XML in an E57; 5 kB for each scan and picture: 10 000 of them

# What a robot tells about its motion, and keyframes on their way to the reconstruction.
MAX_QUATERNION_ERROR = 0.01  # of the norm: four components typed with two decimals are off by 0.005 each, 0.01 in all
MAX_ACCELERATION = 1e4  # m/s^2; a thousand times gravity, beyond any accelerometer of a robot
MAX_TRANSFORMS = 1000  # transforms of one TFMessage; a humanoid with two hands has a hundred joints
MAX_TRANSFORM_FRAMES = 10_000  # names of frames from TF, odometry and IMU: a hundred robots of a hundred frames
MAX_WAITING_MOTION = 1_000_000  # transforms or accelerations since the last keyframe; 10 minutes of 1500 a second
MAX_UNPAIRED = 50  # images without calibration, or the reverse: as deep as the keyframes' topic
MAX_CAMERAS = 64  # keyframes of one moment: more cameras than any robot has

# Texts and times.
MAX_NAME = 256  # characters of a frame or class name; ROS 2 limits topic names to as many
MAX_SECONDS = 2**31 - 1  # s; builtin_interfaces/Time has 32 bits with a sign

# Bills of quantities, board files and results.
MAX_CLASSES = 1000  # planned classes; all sizes of EN 10220 in all their walls are 600
MAX_BILL_ROWS = 5000  # of a table; MAX_CLASSES with headings, sums and empty rows between them
MAX_BILL_COLUMNS = 256  # of a table; a bill has twenty
MAX_SHEETS = 32  # of a workbook that are looked through; a project's bill has one for each trade
MAX_XLSX = 16 << 20  # bytes of a workbook; MAX_BILL_ROWS of 20 columns take 1 MB
MAX_XLSX_CONTENT = 64 << 20  # bytes that a workbook inflates to; tables inflate tenfold, openpyxl reads 8 MB a second
MAX_IFC = 256 << 20  # bytes of a plan; a hospital's pipes take 60 MB, and IfcOpenShell ten times that in memory
MAX_PIPE_RADIUS = 50.0  # m; tunnels have 9
MIN_PIPE_RADIUS = 1e-4  # m; capillaries have 0.5 mm, and no camera sees them as pipes
MAX_PIPE_LENGTH = 1e7  # m of one class; the Earth's quarter
MAX_BOARD_CIRCLES = 256  # of one board; calibration targets have 20 x 14 at most, and symmetries go with the cube
MAX_CIRCLES = 2000  # of all boards and scale bars of a site, which has ten boards of five
MAX_KNOWN_DISTANCES = 1000  # between boards; each is measured by hand
MAX_CONTROL_POINTS = 1000  # of a site; surveyors mark ten
MAX_PIPES = 10_000  # of one survey; a storey of a hospital has some hundreds
MAX_SCORED = 2000  # pipes of a result or truth that is scored: each is compared with each
MAX_TARGET_LENGTH = 1e5  # m; a board's circles, and distances between boards on one site

# Maps of earlier surveys (map.npz).
MAX_MAP_ARRAY = 1 << 30  # bytes of one array; MAX_MAP_FEATURES descriptors of 128
MAX_MAP_FEATURES = 1 << 23  # features, 600 of each keyframe: 14 000 keyframes, two hours at two a second
MAX_MAP_CLOUD = 1 << 24  # points, one for each cell of 2 cm: 6700 m2 of surfaces

# Files of text.
MAX_YAML = 1 << 20  # bytes; bills and boards have kilobytes, and libyaml reads a megabyte in under 2 s
MAX_METADATA = 1 << 22  # bytes of a rosbag2 metadata.yaml; 10 000 files of a split recording take 1.5 MB
MAX_JSON = 40 << 20  # bytes; MAX_POSES of a truth.json take 32 MB; of empty lists alone, it takes 1 GB in memory
MAX_TABLE = 64 << 20  # bytes of a trajectory.tum or frames.csv; a frame takes 100: 12 hours at 15 a second
MAX_DEPTH = 32  # collections within each other; rosbag2 has 8 (QoS of a topic), the other files 5
MAX_NODES = 1_000_000  # values of a YAML file after its aliases are followed; MAX_METADATA can hold as many, bare
MAX_TEXT = 1 << 16  # characters of one text in YAML; rosbag2 writes the QoS of 100 publishers as one text of 40 000
MAX_DIGITS = 100  # characters of one number; a double is exact in 24, and Python's int ends at 4300

# Recordings. What a file may make of itself is in proportion to its size: real content does not grow a hundredfold.
MAX_CHUNK = MAX_ENCODED_IMAGE + (1 << 20)  # bytes of a chunk or message, inflated: one image of the largest size
MAX_INFLATION = 100  # times the file's size that its chunks may inflate to; images do 1 to 10, generated ones 50
FREE_CONTENT = 1 << 30  # bytes that they may inflate to whatever the file's size: a second of work; one black image
MAX_WAITING = 1 << 29  # bytes of messages held to sort them by time; chunks of usual size overlap by a few MB
MIN_BYTES_OF_A_RECORD = 16  # bytes in the file, compressed, of one record on the average: a tenth of an IMU's message
FREE_RECORDS = 1 << 20  # records that a file may hold whatever its size; a second of work
MAX_DESCRIPTION = 1 << 20  # bytes of a schema or channel record; the largest of ROS 2 has 60 kB
MAX_CHANNELS = 4096  # topics of one file; a large robot has some hundred
MAX_BAG_PARTS = 10_000  # files of one folder; a week of files of one minute
MAX_SMALL_MESSAGE = 1 << 20  # bytes of CameraInfo, Odometry, IMU or TF; a thousand transforms have 100 kB
MAX_VIDEO_SECONDS = 86_400  # s; a day, more than the battery or the disk of any camera lasts
MAX_TRIED_IMAGES = 300  # images in which the first usable one is sought: ten seconds of video
