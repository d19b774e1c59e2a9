// A step of Adam and of a moving average of the parameters, number by number.
// Source: Kingma and Ba, Adam, ICLR 2015, Algorithm 1.
#pragma once

#include "platform.h"

namespace snarf {

// What all numbers of a step have in common.
struct AdamTask {
  float first_decay, second_decay, epsilon;
  float rate_correction, root_correction;  // 1 / (1 - first_decay^t) and 1 / sqrt(1 - second_decay^t)
  float average_decay;
};

namespace SNARF_ISA {

// base^exponent for an exponent of at least 0, by squaring: a few multiplications, where pow is slow on most GPUs.
SNARF_HD double power(double base, long long exponent) {
  double result = 1;
  for (; exponent > 0; exponent >>= 1, base *= base)
    if (exponent & 1) result *= base;
  return result;
}

// Step t, from 1.
SNARF_HD AdamTask adam_task(float first_decay, float second_decay, float epsilon, float average_decay, long long t) {
  AdamTask task;
  task.first_decay = first_decay;
  task.second_decay = second_decay;
  task.epsilon = epsilon;
  task.rate_correction = float(1 / (1 - power(first_decay, t)));
  task.root_correction = float(1 / sqrt(1 - power(second_decay, t)));
  task.average_decay = average_decay;
  return task;
}

// Moves one number by its gradient. `rate`: the learning rate times rate_correction.
SNARF_HD void adam_number(const AdamTask& task, float rate, float gradient, float& value, float& mean, float& square) {
  mean += (1.f - task.first_decay) * (gradient - mean);
  square += (1.f - task.second_decay) * (gradient * gradient - square);
  value -= rate * mean / (sqrtf(square) * task.root_correction + task.epsilon);
}

SNARF_HD void average_number(const AdamTask& task, float value, float& average) {
  average += (1.f - task.average_decay) * (value - average);
}

}  // namespace SNARF_ISA
}  // namespace snarf
