// SPDX-License-Identifier: BSD-3-Clause
// Ceres on a BAL file, nine parameters a camera, as in its own example: ceres_points FILE SOLVER THREADS
#include <ceres/rotation.h>

#include "common.h"

struct Reprojection {
  double u, v;
  template <typename T>
  bool operator()(const T* const camera, const T* const point, T* residual) const {
    T p[3];
    ceres::AngleAxisRotatePoint(camera, point, p);
    p[0] += camera[3];
    p[1] += camera[4];
    p[2] += camera[5];
    const T x = -p[0] / p[2], y = -p[1] / p[2];
    const T r2 = x * x + y * y;
    const T scale = camera[6] * (1.0 + r2 * (camera[7] + camera[8] * r2));
    residual[0] = scale * x - u;
    residual[1] = scale * y - v;
    return true;
  }
};

int main(int argc, char** argv) {
  FILE* f = argc == 4 ? fopen(argv[1], "r") : nullptr;
  int num_cameras, num_points, num_observations;
  if (!f || fscanf(f, "%d %d %d", &num_cameras, &num_points, &num_observations) != 3) return 2;
  std::vector<int> camera_of(num_observations), point_of(num_observations);
  std::vector<double> pixel(2 * num_observations), camera(9 * num_cameras), point(3 * num_points);
  for (int k = 0; k < num_observations; k++)
    if (fscanf(f, "%d %d %lf %lf", &camera_of[k], &point_of[k], &pixel[2 * k], &pixel[2 * k + 1]) != 4) return 2;
  for (auto* values : {&camera, &point})
    for (double& value : *values)
      if (fscanf(f, "%lf", &value) != 1) return 2;
  fclose(f);

  ceres::Problem problem;
  for (int k = 0; k < num_observations; k++)
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Reprojection, 2, 9, 3>(
                                 new Reprojection{pixel[2 * k], pixel[2 * k + 1]}),
                             nullptr, &camera[9 * camera_of[k]], &point[3 * point_of[k]]);
  ceres::Solver::Options options = OptionsFor(argv[2], atoi(argv[3]));
  auto* order = new ceres::ParameterBlockOrdering;
  for (int i = 0; i < num_points; i++)
    if (problem.HasParameterBlock(&point[3 * i])) order->AddElementToGroup(&point[3 * i], 0);
  for (int i = 0; i < num_cameras; i++)
    if (problem.HasParameterBlock(&camera[9 * i])) order->AddElementToGroup(&camera[9 * i], 1);
  options.linear_solver_ordering.reset(order);
  return SolveAndReport(argv[2], options, problem);
}
