! A plate that is heated at three places: the heat equation over MPI, in Fortran. The plate is cut in slabs of rows, one on
! each rank. Every so many steps the slabs are drawn where they lie and become one picture.
!   mpirun -n 4 heat               writes heat_0000.ppm and so on
!   mpirun -n 4 heat STEPS EVERY   with a picture after every EVERY of STEPS steps (800, 200)

! The simulation, and the renderer of its slab.
module plate
  use, intrinsic :: iso_c_binding
  use mpi
  use dfb
  implicit none

  integer, parameter :: n = 128                      ! cells along each side of the plate
  integer, parameter :: width = 480, height = 320    ! of the pictures

  ! Rows first to last of the plate, with the row before and the one behind. The rim of the plate is held at 0.
  integer :: first, last, below, above
  real(c_float), allocatable :: heat(:, :)

contains

  subroutine start_plate(rank, ranks)
    integer, intent(in) :: rank, ranks
    first = rank * n / ranks + 1
    last = (rank + 1) * n / ranks
    below = merge(rank - 1, MPI_PROC_NULL, rank > 0)
    above = merge(rank + 1, MPI_PROC_NULL, rank < ranks - 1)
    allocate (heat(0:n + 1, first - 1:last + 1))
    heat = 0
    call heat_places()
  end subroutine

  ! Holds three discs at their temperatures.
  subroutine heat_places()
    integer, parameter :: x(3) = [36, 92, 60], y(3) = [44, 36, 94], radius(3) = [14, 8, 11]
    real(c_float), parameter :: temperature(3) = [1.0, 0.875, 0.75]
    integer :: disc, i, j
    do disc = 1, 3
      do j = first, last
        do i = 1, n
          if ((i - x(disc))**2 + (j - y(disc))**2 <= radius(disc)**2) heat(i, j) = temperature(disc)
        end do
      end do
    end do
  end subroutine

  ! Gives the rows next to those of other ranks to these ranks. n must be at least the number of ranks.
  subroutine exchange_rows()
    integer :: error
    call MPI_Sendrecv(heat(:, last), n + 2, MPI_REAL, above, 0, heat(:, first - 1), n + 2, MPI_REAL, below, 0, &
      MPI_COMM_WORLD, MPI_STATUS_IGNORE, error)
    call MPI_Sendrecv(heat(:, first), n + 2, MPI_REAL, below, 1, heat(:, last + 1), n + 2, MPI_REAL, above, 1, &
      MPI_COMM_WORLD, MPI_STATUS_IGNORE, error)
  end subroutine

  subroutine advance()
    real(c_float), allocatable :: next(:, :)
    integer :: i, j
    call exchange_rows()
    allocate (next, source=heat)
    do j = first, last
      do i = 1, n
        next(i, j) = heat(i, j) + 0.234375 * (((heat(i - 1, j) + heat(i + 1, j)) + (heat(i, j - 1) + heat(i, j + 1))) &
          - 4 * heat(i, j))
      end do
    end do
    call move_alloc(next, heat)
    call heat_places()
  end subroutine

  ! The plate is [-1, 1] x [-1, 1] at height 0. Row j is at z from edge(j) to edge(j + 1).
  real(c_float) function edge(j)
    integer, intent(in) :: j
    edge = 2 * real(j - 1, c_float) / n - 1
  end function

  ! Draws the pixels that see this rank's rows, from (0, 2.4, 1.8) towards the middle of the plate.
  function draw_slab(brick, tile, user) bind(c) result(code)
    type(dfb_brick), intent(in) :: brick
    type(dfb_tile), intent(in) :: tile
    type(c_ptr), value :: user
    integer(c_int) :: code
    real(c_float), pointer :: rgba(:, :, :), depth(:, :)
    real(c_float) :: right, up, way, u, v, fu, fv, t
    integer :: x, y, i, j
    call dfb_tile_pixels(tile, rgba, depth)
    do y = tile%y0, tile%y1 - 1
      do x = tile%x0, tile%x1 - 1
        right = ((real(x, c_float) + 0.5) / 240 - 1) / 1.75 ! the ray: right, up, and 1 ahead
        up = (1 - (real(y, c_float) + 0.5) / 160) / 2.625
        way = 2.4 / (0.8 - 0.6 * up) ! ahead, to the plate
        u = (way * right + 1) * (n / 2)
        v = ((1.8 - way * (0.6 + 0.8 * up)) + 1) * (n / 2)
        if (u < 0 .or. u >= n .or. v < first - 1 .or. v >= last) cycle ! the rows of another rank, or beside the plate
        i = int(u + 0.5) ! between the middles of cells i and i + 1
        j = int(v + 0.5)
        fu = (u + 0.5) - i
        fv = (v + 0.5) - j
        t = (1 - fv) * ((1 - fu) * heat(i, j) + fu * heat(i + 1, j)) &
          + fv * ((1 - fu) * heat(i, j + 1) + fu * heat(i + 1, j + 1))
        rgba(1, x, y) = min(1.0, 0.02 + 2.5 * t) ! from dark red over orange to white
        rgba(2, x, y) = 0.01 + t * t
        rgba(3, x, y) = 0.02 + (t * t) * (t * t) * 0.75
        rgba(4, x, y) = 1
        depth(x, y) = way
      end do
    end do
    code = 0
  end function

  subroutine write_ppm(path, pixels)
    character(len=*), intent(in) :: path
    integer(c_int8_t), intent(in) :: pixels(:, :, :)
    integer :: file
    open (newunit=file, file=path, access='stream', form='unformatted', status='replace')
    write (file) 'P6 480 320 255', new_line('a'), pixels(1:3, :, :)
    close (file)
  end subroutine
end module

program heat_equation
  use, intrinsic :: iso_c_binding
  use mpi
  use dfb
  use plate
  implicit none

  ! Column by column. The view: from (0, 2.4, 1.8) to the middle; the projection: perspective.
  real(c_double), parameter :: view(4, 4) = reshape([real(c_double) :: 1, 0, 0, 0, 0, 0.6d0, 0.8d0, 0, &
    0, -0.8d0, 0.6d0, 0, 0, 0, -3, 1], [4, 4])
  real(c_double), parameter :: projection(4, 4) = reshape([real(c_double) :: 1.75d0, 0, 0, 0, 0, 2.625d0, 0, 0, &
    0, 0, -1, -1, 0, 0, -0.1d0, 0], [4, 4])

  type(dfb_config) :: config
  type(dfb_brick) :: slab
  type(dfb_report) :: report
  type(c_ptr) :: fb
  integer(c_int8_t), pointer :: pixels(:, :, :)
  character(len=16) :: name
  integer :: error, steps, every, step

  steps = argument(1, 800)
  every = argument(2, 200)
  call MPI_Init(error)
  if (min(steps, every) < 1) then
    print '(a)', 'heat: STEPS and EVERY must be numbers of 1 or more'
    call MPI_Abort(MPI_COMM_WORLD, 2, error)
  end if
  call dfb_config_init(config, width, height)
  config%blend = DFB_NEAREST
  config%background = [0.01, 0.012, 0.02, 1.0]
  call require(dfb_create(MPI_COMM_WORLD, config, fb))
  call start_plate(int(dfb_rank(fb)), int(dfb_size(fb)))
  slab = dfb_brick(dfb_rank(fb), [-1.0, 0.0, edge(first)], [1.0, 0.0, edge(last + 1)])

  do step = 1, steps
    call advance()
    if (mod(step, every) /= 0) cycle
    call exchange_rows()
    call require(dfb_render(fb, [slab], view, projection, draw_slab))
    if (dfb_is_display_rank(fb)) then
      call dfb_image_rgba8(fb, pixels)
      write (name, '(a, i4.4, a)') 'heat_', step / every - 1, '.ppm'
      call write_ppm(trim(name), pixels)
    end if
  end do

  if (dfb_is_display_rank(fb) .and. steps >= every) then
    call require(dfb_get_report(fb, report))
    print '(a, i0, a, f0.2, a)', 'the last picture: ', report%tiles_touched, ' tiles, ', report%total_ms, ' ms'
  end if
  call dfb_destroy(fb)
  call MPI_Finalize(error)

contains

  subroutine require(status)
    integer(c_int), intent(in) :: status
    if (status == DFB_OK) return
    print '(a)', dfb_last_error()
    call MPI_Abort(MPI_COMM_WORLD, 1, error)
  end subroutine

  ! A number of the command line, or the usual one.
  integer function argument(place, usual)
    integer, intent(in) :: place, usual
    character(len=12) :: text
    integer :: wrong
    argument = usual
    if (command_argument_count() < place) return
    call get_command_argument(place, text)
    read (text, *, iostat=wrong) argument
    if (wrong /= 0) argument = 0
  end function
end program
