import coec

drive = coec.open("sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes")
print(drive.describe())
result = coec.calibrate(drive, depth="stereo", objective="mi", perturb=(-2.0, 1.5, 1.0))
print(result.verdict.decision, result.correction.round(3), "±", result.sigma.round(3))
print(result.T_camera_lidar)
if result.accepted:
    result.export("calibration.json", format="json")
