"""Bundle adjustment on planes, after BALM2.

Liu, Liu and Zhang, "Efficient and Consistent Bundle Adjustment on Lidar Point Clouds", arXiv
2209.08854. `clusters` are the sums that stand for points, `voxels` finds the planes, `cost` is the
cost with its gradient and its exact Hessian, `solver` takes the steps.
"""
