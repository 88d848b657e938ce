// SPDX-License-Identifier: BSD-3-Clause
// What the Ceres programs share: choice of solver, the stopping rule, clocks, the line of JSON they print.
#pragma once
#include <ceres/ceres.h>
#include <sys/resource.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

struct Clock {
  static double Wall() {
    using namespace std::chrono;
    return duration<double>(steady_clock::now().time_since_epoch()).count();
  }
  // User and system time of all threads of the process.
  static double Cpu() {
    rusage u;
    getrusage(RUSAGE_SELF, &u);
    return u.ru_utime.tv_sec + u.ru_stime.tv_sec + 1e-6 * (u.ru_utime.tv_usec + u.ru_stime.tv_usec);
  }
};

// Peak resident memory. VmHWM belongs to this program alone; ru_maxrss may still hold that of the one that started it.
inline double PeakMemoryMib() {
  if (FILE* f = fopen("/proc/self/status", "r")) {
    char line[256];
    long kib = 0;
    while (fgets(line, sizeof line, f))
      if (sscanf(line, "VmHWM: %ld", &kib) == 1) break;
    fclose(f);
    if (kib) return kib / 1024.0;
  }
  rusage u;
  getrusage(RUSAGE_SELF, &u);
  return u.ru_maxrss / 1024.0;
}

// Stop at a relative change of the cost of 1e-6 or after 50 steps, and for no other reason.
inline ceres::Solver::Options OptionsFor(const std::string& solver, int threads) {
  ceres::Solver::Options o;
  o.preconditioner_type = ceres::SCHUR_JACOBI;
  if (solver == "dense_schur") {
    o.linear_solver_type = ceres::DENSE_SCHUR;
  } else if (solver == "sparse_schur") {
    o.linear_solver_type = ceres::SPARSE_SCHUR;
  } else if (solver == "iterative_schur" || solver == "iterative_schur_explicit") {
    o.linear_solver_type = ceres::ITERATIVE_SCHUR;
    o.use_explicit_schur_complement = solver == "iterative_schur_explicit";
  } else {
    fprintf(stderr, "no such solver: %s\n", solver.c_str());
    exit(2);
  }
  o.num_threads = threads;
  o.max_num_iterations = 50;
  o.function_tolerance = 1e-6;
  o.gradient_tolerance = 0;
  o.parameter_tolerance = 0;
  o.logging_type = ceres::SILENT;
  return o;
}

// Notes CPU time, wall time and the best cost so far after every step.
struct Curve : ceres::IterationCallback {
  double cpu = Clock::Cpu(), wall = Clock::Wall(), best = HUGE_VAL;
  std::string text;
  ceres::CallbackReturnType operator()(const ceres::IterationSummary& step) override {
    if (step.step_is_successful || step.iteration == 0) best = std::min(best, step.cost);
    char entry[96];
    snprintf(entry, sizeof entry, "%s[%.6f, %.6f, %.12g]", text.empty() ? "" : ", ", Clock::Cpu() - cpu,
             Clock::Wall() - wall, best);
    text += entry;
    return ceres::SOLVER_CONTINUE;
  }
};

inline int SolveAndReport(const std::string& solver, ceres::Solver::Options& o, ceres::Problem& problem) {
  ceres::Solver::Summary s;
  Curve curve;
  o.callbacks.push_back(&curve);
  ceres::Solve(o, &problem, &s);
  const double cpu_s = Clock::Cpu() - curve.cpu, wall_s = Clock::Wall() - curve.wall;
  printf(
      "{\"contestant\": \"ceres\", \"version\": \"%s\", \"solver\": \"%s\", \"threads\": %d, \"cpu_s\": %.6f, "
      "\"wall_s\": %.6f, \"iterations\": %d, \"initial_cost\": %.12g, \"final_cost\": %.12g, \"curve\": [%s], "
      "\"peak_memory_mib\": %.1f}\n",
      CERES_VERSION_STRING, solver.c_str(), o.num_threads, cpu_s, wall_s,
      s.num_successful_steps + s.num_unsuccessful_steps - 1, s.initial_cost, s.final_cost, curve.text.c_str(),
      PeakMemoryMib());
  return s.IsSolutionUsable() ? 0 : 1;
}
