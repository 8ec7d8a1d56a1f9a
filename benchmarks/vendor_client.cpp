// Takes packets of points from a UDP socket with Unitree's SDK and tells the CPU time of that.
//
// For every number of packets read from standard input it writes one line: the CPU seconds that it
// took to take so many, and the points of all clouds since the start. Build and use:
// benchmarks/vendor_client.py.

#include <cstdio>
#include <cstdlib>
#include <ctime>

#include "unitree_lidar_sdk.h"

static double cpu_seconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

int main(int argc, char **argv) {
  if (argc != 4) {
    std::fprintf(stderr, "usage: %s HOST_PORT LIDAR_PORT PACKETS_PER_CLOUD\n", argv[0]);
    return 2;
  }
  auto *reader = unilidar_sdk2::createUnitreeLidarReader();
  const bool failed = reader->initializeUDP(std::atoi(argv[2]), "127.0.0.1", std::atoi(argv[1]),
                                            "127.0.0.1", std::atoi(argv[3]), false, 0.0f, 100.0f);
  if (failed) return 1;
  std::printf("ready\n");
  std::fflush(stdout);
  unilidar_sdk2::PointCloudUnitree cloud;
  long wanted = 0, points = 0;
  while (std::scanf("%ld", &wanted) == 1) {
    const double begin = cpu_seconds();
    for (long taken = 0; taken < wanted;) {
      if (reader->runParse() != LIDAR_POINT_DATA_PACKET_TYPE) continue;
      ++taken;
      if (reader->getPointCloud(cloud)) points += static_cast<long>(cloud.points.size());
    }
    std::printf("%.9f %ld\n", cpu_seconds() - begin, points);
    std::fflush(stdout);
  }
}
